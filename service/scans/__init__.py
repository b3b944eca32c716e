"""Many scans of one object: reading them, finding their poses, and fusing them into one surface."""
