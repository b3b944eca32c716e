"""Patterns to project: their images, their manifest entries, which frames of a capture belong together, and what they cost. NumPy only."""
