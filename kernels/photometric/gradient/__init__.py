"""Normals and reflectance from spherical gradient illumination."""
