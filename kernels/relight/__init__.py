"""Relighting: environments to per-light weights, and weighted sums of the captured images."""
