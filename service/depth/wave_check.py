"""Whether frames of shifted sinusoids are sinusoids: their readings against the wave through them, and both axes against each other.

A projector or camera that is not linear bends the waves, and a frame of another exposure, pattern or place lies off them; four shifts and
more tell. The mean of a wave is half of white along either axis: where both axes disagree, exposure or ambient light changed between them.
"""

from collections.abc import Sequence

import numpy as np

MOST_PIXELS = 20_000
"""Pixels that are looked at, about."""
LIT = 0.1
"""Least amplitude of a pixel that tells, as a part of that of the brightest (99th percentile)."""
MOST_OFF = 0.05
"""Median deviation of the readings from a wave over its amplitude, and of the means of both axes from each other, from which on it is
said."""


class WaveCheck:
    """Readings of a part of the pixels, collected band by band."""

    def __init__(self, pixels: int) -> None:
        self._step = max(1, pixels // MOST_PIXELS)
        self._amplitude: list[np.ndarray] = []
        self._left: list[np.ndarray] = []
        self._mean: list[np.ndarray] = []

    def add(self, readings: np.ndarray, usable: np.ndarray, waves: Sequence[tuple[Sequence[int], Sequence[float]]]) -> None:
        """Add the pixels of a band.
        `readings`: [frames, channels, pixels] linear. `usable`: [pixels] bool. `waves`: for each axis the frames of its wave, and their
        shifts in turns."""
        light = readings[:, :, np.flatnonzero(usable)[::self._step]].astype(np.float64).sum(axis=1)
        fits = [self._fit(light[list(frames)], np.array(shifts)) for frames, shifts in waves]
        for kept, values in zip((self._amplitude, self._left, self._mean), zip(*fits, strict=True), strict=True):
            kept.append(np.stack(values))

    @staticmethod
    def _fit(light: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turn = 2 * np.pi * shifts
        design = np.column_stack([np.ones(len(turn)), np.cos(turn), np.sin(turn)])
        values = np.linalg.lstsq(design, light)[0]
        freedom = len(turn) - 3
        left = np.sqrt(((light - design @ values) ** 2).sum(axis=0) / freedom) if freedom else np.zeros(light.shape[1])
        return np.hypot(values[1], values[2]), left, values[0]

    def faults(self) -> list[str]:
        """Return sentences about waves that are none, and about axes that disagree."""
        amplitude, left, mean = (np.concatenate(each, axis=1) for each in (self._amplitude, self._left, self._mean))
        if not amplitude.size:
            return []
        lit = amplitude > LIT * np.percentile(amplitude, 99, axis=1, keepdims=True)
        found = []
        for number, (wave, own) in enumerate(zip(amplitude, left, strict=True)):
            off = float(np.median(own[lit[number]] / wave[lit[number]])) if lit[number].any() else 0.0
            if off > MOST_OFF:
                found.append(f"frames[].pattern: the phase frames{' of one axis' if len(amplitude) > 1 else ''} lie {100 * off:.0f} % of "
                             "their amplitude off a sinusoid: check that patterns are linear in light (relit patterns --gamma, "
                             "color_space), and that exposure, order and place of all are the same; or there is as much noise")
        both = lit.all(axis=0) & (mean > 0).all(axis=0)
        if len(mean) > 1 and both.any():
            apart = float(np.median(np.abs(mean[0] - mean[1])[both] / mean[:2, both].mean(axis=0)))
            if apart > MOST_OFF:
                found.append(f"frames[].pattern: the light of columns and of rows differs by {100 * apart:.0f} %: the exposure or the "
                             "ambient light has changed between them")
        return found
