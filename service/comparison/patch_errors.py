"""The errors that the points of a patch share: vertices of a fused surface share readings, and scanners and filters smooth their points.

The mean of a patch then is less sure than that of as many points which err apart. By how much is told by the patches: their means differ
from the means of those around them by more than the noise of single points explains. Form that is smooth over some patches is in both.

Source: Paule and Mandel, "Consensus values and weighting factors", Journal of Research of the National Bureau of Standards 87, 1982, for
the variance that explains the differences, here by a quantile in place of the sum of squares, so that faults of the part do not decide.
"""

import numpy as np
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import ndtri

AROUND, BESIDE = 24, 1.5
"""A patch is compared with those of so many nearest ones that lie farther off than so many sides: errors of neighbours are alike."""
FACING = 6.0
"""Sides of a patch for which a difference of normals counts: what is off on one face of a part is not what is off on the next."""
LEAST_AROUND, LEAST_PATCHES = 4, 40
"""Patches to compare one with, and such patches, below which nothing is told."""
MEDIAN = np.pi / 2
"""Variance of a median of many Gaussian values over that of their mean."""
QUANTILE = 0.9
"""Quantile of the differences that is explained: patches at edges and at faults of the part are fewer than a tenth."""
SURE = 3.0
"""Standard errors of the quantile beyond which the noise of single points does not explain it."""


def shared_error(
    deviation: np.ndarray,  # [p] metres: means of patches
    variance: np.ndarray,  # [p] square metres: of the mean of points that err apart
    middle: np.ndarray,  # [p, 3] metres
    normal: np.ndarray,  # [p, 3] unit
    side_m: float,
) -> float:
    """Return the standard deviation of errors that the points of a patch of a side in metres share, beyond those of single points, metres;
    0 where nothing tells it."""
    places = np.concatenate([middle, FACING * side_m * normal], axis=1)
    beside = cKDTree(places).query(places, k=min(AROUND + 1, len(places)))[1]
    others = np.linalg.norm(middle[beside] - middle[:, None], axis=2) > BESIDE * side_m
    told = others.sum(axis=1) >= LEAST_AROUND
    if told.sum() < LEAST_PATCHES:
        return 0.0
    others, beside = others[told], beside[told]
    left = np.abs(deviation[told] - np.nanmedian(np.where(others, deviation[beside], np.nan), axis=1))
    count = others.sum(axis=1)
    expected = float(ndtri((1 + QUANTILE) / 2))
    density = 2 * np.exp(-(expected**2) / 2) / np.sqrt(2 * np.pi)
    error = np.sqrt(QUANTILE * (1 - QUANTILE) / told.sum()) / density / expected

    def beyond(shared: float) -> float:
        whole = np.maximum(variance + shared**2, np.finfo(np.float64).tiny)  # a mesh without any noise has none
        around = MEDIAN * (others * whole[beside]).sum(axis=1) / count**2
        return float(np.quantile(left / np.sqrt(whole[told] + around), QUANTILE)) / expected - 1

    if beyond(0.0) <= SURE * error:
        return 0.0
    most = float(np.abs(deviation).max() + np.sqrt(variance.max()))
    return float(brentq(beyond, 0.0, most)) if beyond(most) < 0 else most
