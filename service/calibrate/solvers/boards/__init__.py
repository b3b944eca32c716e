"""Devices and boards that explain all corners together, and what devices contradict."""
