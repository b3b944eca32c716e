"""Colours by their standards."""

import numpy as np

AP1_TO_REC709 = np.array([[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]])
"""ACEScg to linear Rec.709 with Bradford adaptation, five digits, as ACES and its CTL publish it."""


def srgb_to_linear(encoded):
    """IEC 61966-2-1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
