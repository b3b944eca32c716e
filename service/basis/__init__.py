"""Captures reduced to a few coefficient images."""
