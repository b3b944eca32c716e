"""The commands that work on this machine."""
