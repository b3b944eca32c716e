"""The scale of albedo from readings in shadow, where the light that other surfaces throw is all that a pixel sends on.

A reading in shadow is s ρ A + a ρ: the albedo ρ found so far times its unknown scale s and the light A that arrives from the other
surfaces, and stray light a that reaches every pixel. Both ρ and A are proportional to readings, so that bounced light is quadratic in their
scale and direct light is linear: the ratio tells the scale. Lit readings hardly do, because normals and lobes imitate bounced light there.

Sources: radiance = direct + ρ K radiance, Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991; the robust regression is
re-weighted least squares, Holland and Welsch, Communications in Statistics 1977; its covariance sums over groups of pixels and over lights
whose errors are alike, Cameron, Gelbach and Miller, "Robust inference with multiway clustering", JBES 2011.
"""

import math
from typing import NamedTuple

import numpy as np

from kernels.spread import MAD_TO_SIGMA

LEAST_COSINE_BEHIND = 0.1
"""A light this far behind the tangent plane (cosine below its negative) does not reach a pixel, whose normal may be wrong by 5°."""
LEAST_COSINE_CAST = 0.2
"""Least cosine of a light that casts a shadow on a pixel: below it, dark readings may be grazing light."""
DARK = 0.3
"""A reading is in cast shadow if it differs from its bounced light by less than this part of the direct light that the pixel would have."""
LIT = 0.6
"""A reading above this part of that direct light is never taken for a shadow."""
DIRECT = 1 / math.pi
"""Direct light of a surface of albedo 1 that faces a light, per irradiance."""
NOISE_FLOOR = 0.003
"""Noise of a reading over its albedo, 1 % of the direct light: smaller bounced light does not count."""
RELATIVE_NOISE = 0.3
"""Relative error of the arriving light at a pixel: patches are coarse, and not every surface is seen."""
CUTOFF = 2.0
"""Residual over its standard deviation at which the weight is one half."""
ROUNDS = 30
"""Most rounds of re-weighting."""
CONVERGED = 1e-3
"""Relative change of the scale that ends the rounds."""
MODEL_ERROR = 0.08
"""Relative error of the arriving light that all pixels share: the median on path-traced surfaces. Surfaces that the camera does not see
and gloss at grazing angles add light, so that the largest errors are too large scales."""
MOST_STRAY = 0.01
"""Most stray light, 3 % of the direct light: in a hollow that bounces evenly, stray light and bounced light look the same."""
LEAST_GROUPS = 5
"""Least number of groups of pixels, and of lights, that must show bounced light."""
LEAST_READINGS = 50
"""Least number of readings in shadow."""
SHOWN = 2.0
"""Bounced light over the noise floor at which a reading counts as showing it."""
DECIDED = 0.4
"""Largest relative standard error at which the images decide the scale."""


class ScaleFit(NamedTuple):
    """The scale of albedo with its uncertainty."""

    scale: float
    """Albedo of the surface over the albedo that was given."""
    sigma: float
    """Standard error of the scale."""
    stray: float
    """Stray light: reading over albedo where no bounced light arrives, per irradiance."""
    readings: int
    """Number of readings in shadow."""


def fit_albedo_scale(ratio: np.ndarray, arriving: np.ndarray, cosine: np.ndarray, group: np.ndarray) -> ScaleFit | None:
    """Fit the scale of albedo to the readings in shadow.

    Args:
        ratio: [n, lights] float64, reading over albedo, per irradiance; NaN where there is no reading.
        arriving: [n, lights] float64, reading over albedo that the light from other surfaces causes at albedo 1.
        cosine: [n, lights] of the angle between normal and light.
        group: [n] int, pixels near each other, whose errors are alike.

    Returns:
        The fit, or None where the images do not decide the scale.
    """
    given = np.isfinite(ratio) & np.isfinite(arriving)
    behind = given & (cosine < -LEAST_COSINE_BEHIND)
    lit = DIRECT * cosine
    facing = given & (cosine > LEAST_COSINE_CAST) & (ratio < LIT * lit)
    groups, lights = np.broadcast_arrays(group[:, None], np.arange(ratio.shape[1]))
    scale, stray = 1.0, 0.0
    for _ in range(ROUNDS):
        direct = ratio - stray - scale * arriving
        used = behind | (facing & (np.abs(direct) < DARK * lit))
        y, x = ratio[used], arriving[used]
        if len(y) < LEAST_READINGS:
            return None
        residual = y - stray - scale * x
        dim = x <= np.median(x)
        floor = NOISE_FLOOR + MAD_TO_SIGMA * float(np.median(np.abs(residual[dim])))
        variance = floor**2 + (RELATIVE_NOISE * scale * x) ** 2
        weight = 1 / (variance * (1 + residual**2 / (CUTOFF**2 * variance)))
        design = np.stack([x, np.ones_like(x)], axis=1)
        gram = (design * weight[:, None]).T @ design
        before = scale
        if np.linalg.cond(gram / np.sqrt(np.outer(np.diag(gram) + 1e-30, np.diag(gram) + 1e-30))) > 1e6:
            return None
        scale, stray = np.linalg.solve(gram, (design * weight[:, None]).T @ y)
        bounded = not 0 <= stray <= MOST_STRAY
        if bounded:
            stray = min(max(stray, 0.0), MOST_STRAY)
            scale = float((weight * x * (y - stray)).sum() / (weight * x * x).sum())
        if scale <= 0:
            return None
        if abs(scale - before) < CONVERGED * scale:
            break
    shows = scale * x > SHOWN * NOISE_FLOOR
    if min(len(np.unique(each[used][shows])) for each in (groups, lights)) < LEAST_GROUPS:
        return None
    score = design * (weight * (y - stray - scale * x))[:, None]
    inverse = np.diag([1 / gram[0, 0], 0.0]) if bounded else np.linalg.inv(gram)
    apart = [_variance(score, inverse, labels) for labels in (groups[used], lights[used], np.arange(len(y)))]
    spread = max(apart[0] + apart[1] - apart[2], apart[0], apart[1])
    unknown = MOST_STRAY / 2 * float((weight * x).sum() / (weight * x * x).sum()) if bounded and stray > 0 else 0.0
    sigma = math.sqrt(spread + unknown**2 + (MODEL_ERROR * scale) ** 2)
    return ScaleFit(float(scale), sigma, float(stray), len(y)) if sigma < DECIDED * scale else None


def _variance(score: np.ndarray, inverse: np.ndarray, label: np.ndarray) -> float:
    """Return the variance of the scale where readings of one label err alike.

    Args:
        score: [readings, 2] derivatives of the cost.
        inverse: [2, 2] of the normal equations.
        label: [readings] int.
    """
    numbers = np.unique(label, return_inverse=True)[1]
    sums = np.stack([np.bincount(numbers, weights=column) for column in score.T], axis=1)
    count = len(sums)
    return float((inverse @ (sums.T @ sums) @ inverse)[0, 0]) * count / max(count - 1, 1)
