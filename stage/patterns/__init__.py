"""Patterns to project: manifest entries, their images, which frames of a capture belong together, and what they cost. NumPy only."""
