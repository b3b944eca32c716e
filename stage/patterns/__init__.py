"""Patterns to project: manifest entries, their images, which frames of a capture belong together, and what they cost. NumPy only.

Functions raise ValueError for a pattern that cannot be, and `collect` ManifestError for frames that do not make a whole code.
"""
