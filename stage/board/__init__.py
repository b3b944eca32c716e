"""Inspection of boards: tiles on a grid, their registration and blending, and the comparison with nominal heights."""
