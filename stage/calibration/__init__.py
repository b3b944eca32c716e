"""Calibration from images of balls, cards and the object itself: lights, dark frame, flat field, saturation. NumPy only."""
