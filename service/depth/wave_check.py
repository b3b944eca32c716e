"""Whether frames of shifted sinusoids are sinusoids: their readings against the wave through them, and both axes against each other.

A projector or camera that is not linear bends the waves, and a frame of another exposure, pattern or place lies off them; four shifts and
more tell. The mean of a wave is half of white along either axis: where both axes disagree, exposure or ambient light changed between them.
It is so in each place of the wave: where it is not, one of the shifts was brighter than the others, or shown twice; three shifts tell.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

MOST_PIXELS = 20_000
"""Pixels that are looked at, about."""
LIT = 0.1
"""Least amplitude of a pixel that tells, as a part of that of the brightest (99th percentile)."""
MOST_OFF = 0.05
"""Median deviation of the readings from a wave over its amplitude, and of the means of both axes from each other, from which on it is
said."""
MOST_ALONG, ALONG_SIGMAS = 0.01, 5.0
"""By how much the light over white follows the wave over its mean, as a part of it and in standard errors, from which on it is said: light
that flickers by 3 % makes 0.02, and direct light 8 % wrong."""

COPIED_PIXELS = 30
"""The least count of pixels with a wave at which two frames are compared: one may read the same on both sides of a wave's peak."""


class WaveCheck:
    """Readings of a part of the pixels, collected band by band."""

    def __init__(self, pixels: int) -> None:
        self._step = max(1, pixels // MOST_PIXELS)
        self._pixels: list[np.ndarray] = []
        self._differ: dict[tuple[int, int], bool] = {}
        self._wave: list[np.ndarray] = []
        self._left: list[np.ndarray] = []
        self._mean: list[np.ndarray] = []

    def add(self, readings: np.ndarray, usable: np.ndarray, waves: Sequence[tuple[Sequence[int], Sequence[float]]], *, first: int) -> None:
        """Add the pixels of a band.
        `readings`: [frames, channels, pixels] linear. `usable`: [pixels] bool. `waves`: for each axis the frames of its wave, and their
        shifts in turns. `first`: the place of the band's first pixel in the image."""
        chosen = np.flatnonzero(usable)[::self._step]
        light = readings[:, :, chosen].astype(np.float64).sum(axis=1)
        fits = [self._fit(light[list(frames)], np.array(shifts)) for frames, shifts in waves]
        for kept, values in zip((self._wave, self._left, self._mean), zip(*fits, strict=True), strict=True):
            kept.append(np.stack(values))
        self._pixels.append(first + chosen)
        for pair in (pair for frames, _ in waves for pair in combinations(frames, 2)):
            self._differ[pair] = self._differ.get(pair, False) or not np.array_equal(light[pair[0]], light[pair[1]])

    @staticmethod
    def _fit(light: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turn = 2 * np.pi * shifts
        design = np.column_stack([np.ones(len(turn)), np.cos(turn), np.sin(turn)])
        values = np.linalg.lstsq(design, light)[0]
        freedom = len(turn) - 3
        left = np.sqrt(((light - design @ values) ** 2).sum(axis=0) / freedom) if freedom else np.zeros(light.shape[1])
        return values[1] + 1j * values[2], left, values[0]

    @property
    def copies(self) -> tuple[int, int] | None:
        """Return two frames of a wave that are exact copies, as noise makes none; None if none are, or hardly any light is."""
        told = sum(int(np.count_nonzero(wave[0])) for wave in self._wave) >= COPIED_PIXELS
        return next((pair for pair, differ in self._differ.items() if told and not differ), None)

    def faults(self, over_white: np.ndarray | None) -> list[str]:
        """Return sentences about waves that are none, about axes that disagree, and about light that follows the waves.
        `over_white`: [pixels of the image] direct and global light together over the white frame, NaN where it is not known; None: it is
        nowhere."""
        wave, left, mean = (np.concatenate(each, axis=1) for each in (self._wave, self._left, self._mean))
        if not wave.size:
            return []
        amplitude = np.abs(wave)
        lit = amplitude > LIT * np.percentile(amplitude, 99, axis=1, keepdims=True)
        found = []
        for number, (swing, own) in enumerate(zip(amplitude, left, strict=True)):
            off = float(np.median(own[lit[number]] / swing[lit[number]])) if lit[number].any() else 0.0
            if off > MOST_OFF:
                found.append(f"frames[].pattern: the phase frames{' of one axis' if len(amplitude) > 1 else ''} lie {100 * off:.0f} % of "
                             "their amplitude off a sinusoid: check that patterns are linear in light (relit patterns --gamma, "
                             "color_space), and that exposure, order and place of all are the same; or there is as much noise")
        if over_white is not None:
            ratio = over_white[np.concatenate(self._pixels)]
            along = max(_along(ratio[own], one[own] / light[own]) for one, light, own
                        in zip(wave, mean, lit & (mean > 0) & np.isfinite(ratio), strict=True))
            if along > MOST_ALONG:
                found.append("frames[].pattern: direct and global light add up to more of the white frame in some places of the wave than "
                             f"in others, by {100 * along:.2g} %: the exposure or the lamp has changed between the phase frames, or one "
                             "shows another shift")
        both = lit.all(axis=0) & (mean > 0).all(axis=0)
        if len(mean) > 1 and both.any():
            apart = float(np.median(np.abs(mean[0] - mean[1])[both] / mean[:2, both].mean(axis=0)))
            if apart > MOST_OFF:
                found.append(f"frames[].pattern: the light of columns and of rows differs by {100 * apart:.0f} %: the exposure or the "
                             "ambient light has changed between them")
        return found


def _along(ratio: np.ndarray, wave: np.ndarray) -> float:
    """Return by how much ratios [n] follow a wave [n], complex and over its mean, as a part of it; 0 where that is not sure."""
    design = np.column_stack([np.ones(len(ratio)), wave.real, wave.imag])
    if len(ratio) <= design.shape[1]:
        return 0.0
    values, squares, *_ = np.linalg.lstsq(design, ratio)
    error = np.sqrt(squares.sum() / (len(ratio) - 3) / (np.abs(wave) ** 2).sum() * 2)
    size = float(np.hypot(values[1], values[2]))
    return size if size > ALONG_SIGMAS * error else 0.0
