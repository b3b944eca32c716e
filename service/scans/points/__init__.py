"""Scans in memory: points, their neighbours, squares of pixels and rigid motions."""
