"""Depth from projected patterns, lasers, time of flight and several cameras; direct and global light; and the patterns to project."""
