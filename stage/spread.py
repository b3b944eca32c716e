"""The spread of values from medians, which few wrong values among them do not change, and of what is fitted to values that share errors.

MAD_TO_SIGMA has a twin in kernels/spread.py, because stage and kernels never import each other.
"""

import numpy as np

MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of Gaussian values to the median of their magnitudes, 1 / Φ⁻¹(3/4)."""
TUKEY = 4.685
"""Residuals beyond this many standard deviations count nothing. Source: Tukey's biweight, 95 % efficient on normal noise."""
BLOCKS = 5
"""Blocks along each side of an image, whose values are taken to share an error."""


def tukey_weights(left: np.ndarray, scale: float | np.ndarray) -> np.ndarray:
    """Return the weights, 0…1, of residuals whose standard deviation is `scale`, by Tukey's biweight."""
    return np.asarray(np.square(np.clip(1 - np.square(left / (TUKEY * scale)), 0, None)))


def blocks_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the block of each place of an image, [values] below BLOCKS²: as many places stand in each column, and in each row, of blocks.
    `x`, `y`: [values] places across and down, in any unit."""
    across, down = (np.searchsorted(np.quantile(places, np.arange(1, BLOCKS) / BLOCKS), places) for places in (x, y))
    return np.asarray(across * BLOCKS + down)


def between_blocks(covariance: np.ndarray, scores: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the covariance of fitted parameters for what whole blocks of an image leave alike, [parameters, parameters].

    Source: Liang and Zeger, "Longitudinal data analysis using generalized linear models", Biometrika 73, 1986, for residuals that
    clusters share.

    Args:
        covariance: [parameters, parameters] inverse of the normal equations.
        scores: [values, parameters] residuals times their weights and slopes.
        x: [values] places across the image, in any unit.
        y: [values] places down the image, in any unit.
    """
    sums = np.zeros((BLOCKS**2, scores.shape[1]))
    np.add.at(sums, blocks_of(x, y), scores)
    return np.asarray(covariance @ (sums.T @ sums) @ covariance)
