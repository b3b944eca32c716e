"""Normals and reflectance from images under known lights."""
