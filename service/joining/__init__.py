"""Depth and normals of one view joined into one surface."""
