"""Sequences: a solve or a depth of every time step, and what its steps have in common joined."""
