"""Colour spaces, what a pixel's radiance may be, and environment maps."""
