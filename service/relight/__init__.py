"""Relit frames: weighted sums of captured images, guided by solved maps, and solved maps under lights."""
