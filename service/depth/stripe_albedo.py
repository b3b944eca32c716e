"""The albedo of the pixels that a sweep of laser planes lights, from the sweep itself.

While the planes pass over a pixel, it reads its albedo times the profile of the stripe, sampled at the planes. The energy Σ I² over the
frames is then the albedo squared times the same constant for every pixel, if the planes lie close enough: a Gaussian profile of standard
deviation s planes leaves a ripple of 2 exp(-π² s²), 0.4 % at s = 0.8. The number of frames that share the energy, (Σ I²)² / Σ I⁴ = 2.5 s,
tells where they do, and where the sweep begins or ends over a pixel.

Source: Curless and Levoy, "Better optical triangulation through spacetime analysis", ICCV 1995: over the frames, texture does not bend the
profile of a pixel.
"""

import numpy as np

LEAST_FRAMES = 2.0
"""Least number of frames that share the energy of a pixel: with fewer, the ripple is above 0.4 %."""
LEAST_PART = 0.75
"""Least part of the commonest number of frames: where the sweep ends over a pixel, part of its energy is missing."""
SIGNIFICANT = 3.0
"""Standard deviations of the noise from which a reading counts as light of the stripe."""
LEAST_SIGNAL = 10.0
"""Least root of the energy in standard deviations of the noise: the albedo is then known to a tenth."""
WINDOW_PX = 5
"""Side of the window over which the texture of the albedo is compared with its noise, pixels."""


class SweepEnergy:
    """The energy of each pixel over the frames of a sweep."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        """Begin with no frame.

        Args:
            shape: rows and columns.
        """
        self.square = np.zeros(shape, np.float32)
        self.fourth = np.zeros(shape, np.float32)
        self.noise2 = 0.0
        self.frames = 0

    def add(self, signal: np.ndarray, noise: float) -> None:
        """Add a frame.

        Args:
            signal: [rows, cols] float32, less its background.
            noise: its standard deviation where there is no stripe.
        """
        square = np.where(signal > SIGNIFICANT * noise, signal, 0).astype(np.float32) ** 2
        self.square += square
        self.fourth += square * square
        self.noise2 += noise * noise
        self.frames += 1

    def albedo(self) -> np.ndarray | None:
        """Return the relative albedo, [rows, cols] float32, 0 where the sweep does not tell it; None if it tells it nowhere.

        Texture that does not stand out of its noise is smoothed (Lee, "Digital image enhancement and noise filtering by use of local
        statistics", PAMI 1980): there a division by it would only add noise.
        """
        if self.frames < LEAST_FRAMES:
            return None
        noise2 = self.noise2 / self.frames
        lit = self.square > LEAST_SIGNAL**2 * noise2
        shared = np.where(lit, self.square**2 / np.where(lit, self.fourth, 1), 0).astype(np.float32)
        around = _mean(shared, lit)
        known = lit & (around >= LEAST_FRAMES)
        if not known.any():
            return None
        known &= shared >= LEAST_PART * np.median(shared[known])
        root = np.sqrt(self.square)
        middle = _mean(root, known)
        variance = np.maximum(_mean(root * root, known) - middle * middle, 0)
        texture = np.maximum(1 - noise2 / np.maximum(variance, 1e-12 * noise2 + 1e-30), 0)
        found = middle + texture * (root - middle)
        return np.where(known & (found > 0), found, 0).astype(np.float32)


def _mean(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return the mean of the values over a window, of those pixels that are marked; 0 where none is."""
    weight = _sum_around(where.astype(np.float32))
    return np.where(weight > 0, _sum_around(np.where(where, values, 0).astype(np.float32)) / np.maximum(weight, 1), 0)


def _sum_around(values: np.ndarray) -> np.ndarray:
    """Return the sum over the window about each pixel; beyond the image values count as 0."""
    for axis in (0, 1):
        room = [(0, 0), (0, 0)]
        room[axis] = (WINDOW_PX // 2, WINDOW_PX // 2)
        padded = np.pad(values, room)
        length = values.shape[axis]
        values = np.add.reduce([np.take(padded, range(start, start + length), axis=axis) for start in range(WINDOW_PX)])
    return values
