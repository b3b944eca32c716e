"""Directions on the sphere: lat-long maps, grids and triangulations."""
