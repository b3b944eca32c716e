"""Horizons and occlusion of a height field."""
