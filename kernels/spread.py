"""The spread of values from medians, which few wrong values among them do not change.

Its twin is stage/spread.py, because stage and kernels never import each other.
"""

MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of Gaussian values to the median of their magnitudes, 1 / Φ⁻¹(3/4)."""
