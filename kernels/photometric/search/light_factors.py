"""Intensities of the lights from the object: the factor by which the readings of each light miss what normals and lobes predict.

Normals and factors are found in turn: under the factors so far, the search explains the readings of some hundreds of pixels, and the
median ratio of the lit readings of a light to their prediction is the change of its factor. Three things no object can tell: a common
factor, which is albedo, one that falls with the angle to the viewer, which is another shape of the diffuse lobe, and, roughly, one that is
linear in the direction of the light across the view; they are taken out.
The factors are believed where those of one half of the object make the other half much easier to explain.

Sources: lights of unknown intensity and known directions, Cho, Matsushita, Tai and Kweon, "Semi-calibrated photometric stereo", TPAMI
2020; choice by left-out data, Stone, "Cross-validatory choice and assessment of statistical predictions", JRSS B 1974.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.model.samples import Samples, device_values, host_values
from kernels.photometric.search.descent import COLD, WARM, descend
from kernels.photometric.search.hypotheses import LobeShape, predict
from kernels.spread import MAD_TO_SIGMA

TRIAL_ROUNDS, ROUNDS = 2, 12
"""Rounds of each half, which show whether factors explain anything, and of the whole object."""
STRIDE = 1.7
"""Factor on each change: normals follow wrong intensities, so that plain turns take three times as many rounds."""
LEAST_COSINE = 0.25
"""Least cosine between normal and light of a reading that is compared: below it, shadows and grazing reflection miss the prediction."""
LIT = 0.3
"""Least part of its prediction that a lit reading has."""
BRIGHT = 0.2
"""Least prediction, relative to the level of the pixel, of a reading that is compared."""
MATT = 0.5
"""Least diffuse part of the prediction of a reading that is compared: the tails of highlights miss real ones alike under near lights, and
bare metal has nothing else."""
LEAST_PIXELS = 20
"""Least number of pixels that must compare a light for its factor to change."""
LEAST_GAIN = 0.02
"""Least part of the cost of left-out pixels that factors must take away: below 0.01 where intensities are right, also where the lobes do
not explain the object, 0.04 where they are off by 1 %."""
SURE = 2.5
"""Least ratio of that gain to its standard error over squares of pixels."""
FIT_ROUNDS, GROSS = 5, 4.0
"""Rounds in which lights off by more than this many standard deviations are left out of the fit of the part that no object can tell: one
wrong light must not bend all others."""
LARGEST_LINEAR = 4.0
"""Largest part of the factors that is linear across the view, in standard deviations of what independent errors of the lights give."""


class LightFactors(NamedTuple):
    """Intensities of the lights that the object asks for."""

    factor: np.ndarray  # [lights] float64: true intensity over the declared one; its logarithm is centred on 0
    gain: float
    """Part of the cost of left-out pixels that the factors of the other half take away."""
    believed: bool
    """True if the gain is more than noise and misfit give; else the factors are 1."""


def find_light_factors(samples: Samples, start: np.ndarray, directions: np.ndarray, row: np.ndarray, col: np.ndarray, *,
                       shape: LobeShape) -> LightFactors:
    """Find the factors of the intensities, and whether to believe them.
    `samples`: direct light of some hundreds of pixels, spread over the object. `directions`: [lights, 3] unit, in the camera frame.
    `row, col`: [n] int, the square of the image that each pixel lies in; the squares of one half are those of a chessboard's colour."""
    half = (row + col) % 2 == 0
    square = np.unique(np.stack([row, col]), axis=1, return_inverse=True)[1].reshape(-1)
    same = np.ones(len(directions))
    if min(half.sum(), (~half).sum()) < LEAST_PIXELS:
        return LightFactors(same, 0.0, believed=False)
    before, after = np.empty(len(start)), np.empty(len(start))
    for fitted in (half, ~half):
        found = _factors(choose(samples, fitted), start[fitted], directions, shape, TRIAL_ROUNDS)
        rest = choose(samples, ~fitted)
        for cost, factor in ((before, same), (after, found)):
            cost[~fitted] = descend(_divided(rest, factor), start[~fitted], shape=shape).cost
    less = np.bincount(square, weights=before - after)
    gain = float(less.sum() / max(before.sum(), 1e-12))
    believed = gain > LEAST_GAIN and bool(less.sum() > SURE * np.sqrt((less**2).sum()))
    return LightFactors(_factors(samples, start, directions, shape, ROUNDS) if believed else same, gain, believed)


def _factors(samples: Samples, start: np.ndarray, directions: np.ndarray, shape: LobeShape, rounds: int) -> np.ndarray:
    """Return [lights] factors after some rounds of search and comparison."""
    logarithm, normal, weights, schedule = np.zeros(len(directions)), start, None, COLD
    for step in range(rounds):
        divided = _divided(samples, np.exp(logarithm))
        found = descend(divided, normal, shape=shape, weights=weights, schedule=schedule)
        normal, weights, schedule = found.normal, found.weights, WARM
        reading, predicted = host_values(divided, divided.grey), predict(divided, normal, weights, shape=shape)
        matt = predict(divided, normal, weights * (np.arange(weights.shape[1]) == 0), shape=shape)
        lit = (matt > MATT * predicted) & (normal @ directions.T > LEAST_COSINE) & (predicted > BRIGHT) & (reading > LIT * predicted)
        ratio = np.where(lit, np.log(np.where(lit, reading, 1) / np.where(lit, predicted, 1)), np.nan)
        change = np.array([np.nanmedian(column) if told else 0.0
                           for column, told in zip(ratio.T, lit.sum(axis=0) >= LEAST_PIXELS, strict=True)])
        logarithm += (STRIDE if step else 1.0) * change
        logarithm -= untold(logarithm, directions, falling=True)
    return np.exp(logarithm)


def _divided(samples: Samples, factor: np.ndarray) -> Samples:
    """Return the samples with the grey readings of each light divided by its factor."""
    values = host_values(samples, samples.grey)
    return samples._replace(grey=device_values(samples, np.where(values >= 0, values / factor, -1)))


def untold(logarithm: np.ndarray, directions: np.ndarray, *, falling: bool) -> np.ndarray:
    """Return the part of the logarithms of the factors that the object cannot tell, or that independent errors of lights do not have.

    A factor that is linear in the direction across the view turns all normals, which shading tells only weakly; it is kept as far as
    errors of the size of the others would give it.
    `falling`: whether a part that falls with the angle to the viewer cannot be told at all, because the shape of the diffuse lobe is
    free; else it is kept like those across the view."""
    design = np.stack([np.ones(len(directions)), directions[:, 2], directions[:, 0], directions[:, 1]], axis=1)
    found, spread = _robust_fit(design, logarithm)
    centred = design - design.mean(axis=0)
    kept = np.zeros(4)
    for column in range(2 if falling else 1, 4):
        extent = (design if column > 1 else centred)[:, column]
        most = LARGEST_LINEAR * spread / max(float(np.linalg.norm(extent)), 1e-9)
        kept[column] = np.clip(found[column], -most, most)
    return design @ (found - kept)


def _robust_fit(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the coefficients of a fit without the lights that are grossly wrong, and the robust standard deviation of the rest."""
    used = np.ones(len(values), dtype=bool)
    for _ in range(FIT_ROUNDS):
        found = np.linalg.lstsq(design[used], values[used], rcond=None)[0]
        residual = values - design @ found
        spread = MAD_TO_SIGMA * float(np.median(np.abs(residual))) + 1e-9
        used = np.abs(residual) <= GROSS * spread
    return found, spread
