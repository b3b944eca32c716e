"""Fused meshes: holes, bands of vertices, and normals joined to them."""
