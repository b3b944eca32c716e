"""Meshes of triangles: their files and their holes."""
