"""Scans of one object from several places: the file that lists them, their points, and the registration of their poses."""
