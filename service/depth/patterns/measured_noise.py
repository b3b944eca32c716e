"""The noise of the frames by themselves: frames, or sums of them, that are the same light at a pixel differ by noise alone.

A bit and its inverse, a wave over its shifts, a ramp and the opposite one, white and black: their means are the light half way between
white and black. A bit without an inverse is white or black where it is lit or dark: it tells the noise of waves beside it, while stripes
alone are read rightly in far more noise than is declared. What changes smoothly between two of these (lamps that age, light below
surfaces, waves that the projector bends) is taken off by second differences along image rows or columns: waves are straight along their
stripes.
"""

from collections.abc import Iterator
from itertools import pairwise
from math import ceil

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.levels import COARSE, HALVES, even_means, row_of
from service.depth.patterns.pattern_checks import ENOUGH, sample_of
from stage.capture.camera import Camera
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.modulated import ModulatedCode
from stage.patterns.phase import PhaseCode
from stage.spread import MAD_TO_SIGMA
from stage.stack.planes import Planes

TRIPLES = 32
"""Number of groups of three neighbouring image rows that are looked at, evenly spread."""
CLEAR = 0.25
"""Distance from white or black, as a part of their difference, within which a bit is lit or dark."""
NOISIER, SAID_NOISIER = 1.25, 2.0
"""Noise in the noise that is declared from which on it is taken instead, and from which on that is said."""


def with_measured_noise(planes: Planes, camera: Camera, mask: np.ndarray, collected: Collected,
                        noise: NoiseModel) -> tuple[NoiseModel, float]:
    """Return the noise of the frames and how many times the declared one it is: that itself and 1 where the frames are no noisier, or do
    not tell."""
    first = np.unique(np.linspace(0, len(mask) - 1, TRIPLES + 2).astype(int)[1:-1] // 3 * 3)
    first = first[first + 2 < len(mask)]
    rows = (first[:, None] + np.arange(3)).ravel() if len(first) else np.arange(len(mask))
    shape = (-1, min(3, len(mask)), mask.shape[1])
    sample = sample_of(planes, camera, mask, rows)
    grey = sample.grey
    variance, lit = noise.variance(grey), sample.lit(grey, noise)
    across: list[float] = []
    along: list[float] = []
    for apart, expected, alike in _differences(collected, grey, variance):
        apart, expected, alike = (each.reshape(shape) for each in (apart, expected, np.where(lit, alike, 0)))
        for factors, axis in ((across, 2), (along, 1)):
            factor = _factor(*(np.moveaxis(each, axis, -1) for each in (apart, expected, alike)))
            factors += [] if factor is None else [factor]
    told = [float(np.median(factors)) for factors in (across, along) if factors]
    factor = min(told, default=1.0)
    return (noise, 1.0) if factor < NOISIER else (NoiseModel(noise.read * factor, noise.gain * factor**2), factor)


def _differences(collected: Collected, grey: np.ndarray, variance: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield differences of readings [frames, …] that are the same light, their expected variance, and the kind of light, 0 where none:
    pixels of one kind are compared."""
    frames = len(grey)
    references = None if collected.white is None or collected.black is None else (collected.white, collected.black)
    means = [] if references is None else [row_of(frames, references, HALVES)]
    means += [row for code in collected.codes for row in even_means(code, frames)]
    pairs = list(pairwise(means))
    for code in collected.codes:
        if isinstance(code, ModulatedCode) and len(code.frames) % 2 == 0:  # a wave and that of half a turn, over the shifts of the carrier
            half = len(code.frames) // 2
            opposite = [(*code.frames[step], *code.frames[step + half]) for step in range(half)]
            pairs += pairwise(row_of(frames, each, np.full(len(each), 1 / len(each))) for each in opposite)
    for one, other in pairs:
        weights = (one - other).astype(np.float32)
        yield np.tensordot(weights, grey, 1), np.tensordot(weights**2, variance, 1), np.ones(grey.shape[1:], int)
    if references is None or not any(isinstance(code, PhaseCode) for code in collected.codes):
        return
    white, black = (grey[number] for number in references)
    for code in collected.codes:
        if isinstance(code, BinaryCode) and code.inverses is None:
            for number in code.frames[-ceil(COARSE * len(code.frames)):]:
                part = (grey[number] - black) / np.maximum(white - black, 1e-9)
                lit, dark = np.abs(part - 1) < CLEAR, np.abs(part) < CLEAR
                yield (grey[number] - np.where(lit, white, black), variance[number] + np.where(lit, *(variance[n] for n in references)),
                       np.where(lit, 1, np.where(dark, 2, 0)))


def _factor(apart: np.ndarray, expected: np.ndarray, alike: np.ndarray) -> float | None:
    """Return by how much second differences along the last axis spread more than expected; None of too few."""
    def three(values: np.ndarray, middle: float) -> np.ndarray:
        return np.asarray(values[..., :-2] + values[..., 2:] + middle * values[..., 1:-1])

    compared = (alike[..., 1:-1] > 0) & (alike[..., :-2] == alike[..., 1:-1]) & (alike[..., 2:] == alike[..., 1:-1])
    if compared.sum() < ENOUGH:
        return None
    bend, spread = three(apart, -2), three(expected, 4)
    return float(MAD_TO_SIGMA * np.median(np.abs(bend[compared]) / np.sqrt(spread[compared])))
