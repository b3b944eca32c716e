"""Depth from laser spots and stripes."""
