"""Depth from time of flight."""
