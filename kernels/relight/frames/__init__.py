"""Weighted sums of captured images: one frame, many frames, near lights."""
