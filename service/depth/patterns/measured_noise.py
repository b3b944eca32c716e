"""The noise of the frames by themselves: sums of frames that are the same even light differ by noise alone.

A bit and its inverse, a wave over its shifts, a ramp and the opposite one, white and black: their means are the light half way between
white and black, at every pixel. What changes smoothly between two of them (lamps that age, light below surfaces) is taken off by second
differences along image rows.
"""

from itertools import pairwise

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.levels import HALVES, even_means, row_of
from service.depth.patterns.pattern_checks import ENOUGH, Sample
from stage.patterns.codes import Collected
from stage.spread import MAD_TO_SIGMA

UNBENT_STEPS = 4
"""Number of shifts from which on the mean of a wave is even light even where the projector's response bends it: that of three is not."""
NOISIER, SAID_NOISIER = 1.25, 2.0
"""Noise in the noise that is declared from which on it is taken instead, and from which on that is said."""


def with_measured_noise(sample: Sample, collected: Collected, noise: NoiseModel) -> tuple[NoiseModel, float]:
    """Return the noise of the frames and how many times the declared one it is: that itself and 1 where the frames are no noisier, or do
    not tell."""
    sums = _even_sums(collected, len(sample.values))
    grey = sample.grey
    lit = sample.lit(grey, noise).reshape(sample.mask.shape)
    compared = lit[:, :-2] & lit[:, 1:-1] & lit[:, 2:]
    if len(sums) < 2 or compared.sum() < ENOUGH:
        return noise, 1.0
    variance = noise.read**2 + noise.gain * np.maximum(grey, 0)
    factors = []
    for one, other in pairwise(sums):
        apart = (one - other) @ grey
        expected = (one - other) ** 2 @ variance
        bend, spread = (np.reshape(each, lit.shape) for each in (apart, expected))
        bend = bend[:, :-2] - 2 * bend[:, 1:-1] + bend[:, 2:]
        spread = spread[:, :-2] + 4 * spread[:, 1:-1] + spread[:, 2:]
        factors.append(MAD_TO_SIGMA * np.median(np.abs(bend[compared]) / np.sqrt(spread[compared])))
    factor = float(np.median(factors))
    return (noise, 1.0) if factor < NOISIER else (NoiseModel(noise.read * factor, noise.gain * factor**2), factor)


def _even_sums(collected: Collected, frames: int) -> list[np.ndarray]:
    """Return the weights [frames] float32 of the frames in each mean that is half the light of white and black."""
    rows = []
    if collected.white is not None and collected.black is not None:
        rows.append(row_of(frames, (collected.white, collected.black), HALVES))
    rows += [row for code in collected.codes for row in even_means(code, frames, UNBENT_STEPS)]
    return [row.astype(np.float32) for row in rows]
