"""Solving captures for normals, reflectance and height."""
