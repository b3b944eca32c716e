"""Scans compared with the design of the part: where it lies, by how much the scan deviates, and whether that is allowed."""
