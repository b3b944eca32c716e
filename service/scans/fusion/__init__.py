"""Fusion of scans with poses into one surface, brick by brick, and what is made of it."""
