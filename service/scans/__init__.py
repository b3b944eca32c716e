"""Many scans of one object: reading them, and finding their poses."""
