"""Directions on the sphere: lat-long maps and grids."""
