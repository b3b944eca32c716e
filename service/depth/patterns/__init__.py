"""Depth from projected codes."""
