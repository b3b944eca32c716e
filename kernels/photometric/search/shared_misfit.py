"""Measure how much of what a search leaves unexplained is common to neighbouring pixels.

Noise differs from pixel to pixel. What the model lacks (another reflectance, light from other surfaces, lights that are off) is nearly the
same at pixels close to each other and under lights close to each other: many lights do not average it, and it bends the surface that
neighbours make together, so that their normals hardly contradict it. Its share in the residuals tells noise from misfit for each capture,
without its truth.

Source: residuals as data about the model's own error, Kennedy and O'Hagan, "Bayesian calibration of computer models", Journal of the Royal
Statistical Society B 2001; the median of the products of pairs, as in `photometric/model/misfit.py`, is ours.
"""

import numpy as np

from kernels.photometric.model.samples import Samples, host_values
from kernels.photometric.search.descent import Descent
from kernels.photometric.search.hypotheses import LobeShape, SearchOptions, predict
from kernels.photometric.search.survey import evidence

UNKNOWN_SHARE = 0.25
"""Share that is taken where there are no pairs of pixels: that of the real objects that were measured."""
EXPLAINED = 0.15
"""Cost of a reading up to which a mixture of lobes explains a pixel. What it leaves of others, above all of metals, is that of lobes whose
widths are fixed: neighbours share it, but a lobe of their own finds their normals."""
DARK = 0.02
"""Part of a pixel's level below which a reading is dark whatever the normal, and says nothing."""
UNEXPLAINED = 1 / 8
"""Part of what pairs that are not explained have in common that counts: a ball of metal before a body of metal has normals at its rim that
err by as much, and hardly a pair there is explained."""
OUTLYING = 2.0
"""Residual, in units of the noise of the cost, beyond which a reading is a shadow or a highlight of its own."""


def shared_misfit(samples: Samples, found: Descent, *, shape: LobeShape) -> float:
    """Return the share, 0…1, of the squared residuals that both pixels of a pair have in common, in the middle pair of those that are
    explained and of the others, of which UNEXPLAINED counts; waits for the device.
    `samples`: the first pixels of all pairs, then the second ones. `found`: their descents under `shape`."""
    options, count = SearchOptions(), samples.pixel_count // 2
    if not count:
        return UNKNOWN_SHARE
    explained = (evidence(samples, found.cost, found.weights).noise < EXPLAINED).reshape(2, count).all(axis=0)
    reading = host_values(samples, samples.grey).astype(np.float64)
    predicted = predict(samples, found.normal, found.weights, shape=shape)
    residual = (reading - predicted) / options.noise(reading)
    counts = (reading > DARK) & (np.abs(residual) < OUTLYING) & (reading > options.shadow_depth * predicted)
    first, second = np.where(counts, residual, 0).reshape(2, count, -1)
    part = float(explained.mean())
    others = UNEXPLAINED * (1 - part) * _in_common(first[~explained], second[~explained])
    return part * _in_common(first[explained], second[explained]) + others


def _in_common(first: np.ndarray, second: np.ndarray) -> float:
    """Return the share of the squared residuals, 0…1, that the middle pair has in common; 0 without pairs.
    `first`, `second`: [pairs, lights] residuals of both pixels."""
    if not len(first):
        return 0.0
    common, total = np.median((first * second).sum(axis=1)), np.median(0.5 * (first**2 + second**2).sum(axis=1))
    return float(np.clip(common / max(total, 1e-30), 0, 1))
