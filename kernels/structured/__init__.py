"""Codes projected by a projector or a laser: images in, projector coordinates and their uncertainty out."""
