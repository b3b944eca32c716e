"""Depth from two or more cameras."""
