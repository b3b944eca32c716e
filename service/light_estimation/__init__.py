"""Directions and intensities of lights from images: estimates, and checks of what a manifest declares."""
