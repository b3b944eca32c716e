"""Projected patterns, lasers and time of flight to depth."""
