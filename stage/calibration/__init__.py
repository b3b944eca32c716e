"""Calibration from images of balls, cards, boards and the object: lights, dark frame, flat field, saturation, projector."""
