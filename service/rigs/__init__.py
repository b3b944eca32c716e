"""Rig files: made from captures and tables, checked, and planned."""
