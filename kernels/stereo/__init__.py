"""Matching of two rectified images: census, semi-global matching, checks, and refinement to a fraction of a pixel."""
