"""Depth from projected patterns, lasers and time of flight; direct and global light; and the patterns to project."""
