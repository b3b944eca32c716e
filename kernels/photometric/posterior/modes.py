"""The best and the second-best mode of a search over the visible hemisphere, and how probable it is that the best one is right.

A grid of candidates over the hemisphere has several minima where normals far apart explain the readings alike. The best two are found
here; each is then refined, and its posterior summed (`posterior`). The shares of the two sums are the probabilities of the modes.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.model.candidates import rings
from kernels.photometric.model.samples import Samples
from kernels.photometric.posterior.posterior import Model, Posterior, tangents
from kernels.photometric.posterior.scores import score_normals

GRID_RINGS = (tuple(float(d) for d in range(7, 90, 7)), 52)
"""Radii, degrees, and candidates on the last ring of the grid: candidates lie 7° apart."""
GRID_NOISE = (0.1, 0.6)
"""Noise that the grid assumes, relative to level and reading: as wide as its steps, because readings of a mirror change by half from one
candidate to the next, and a narrower cost would miss the minimum between them."""
GRID_FLOATS = 3 * len(rings(*GRID_RINGS))
"""Numbers that the grid keeps for each pixel while it is worked on."""
APART = 18.0
"""Least angle between the two modes, degrees: two and a half steps of the grid, so that a minimum between candidates counts as one."""
SAME = 3.0
"""Refined modes nearer to each other than this many of their standard deviations, or than half of APART, are one: the rings around the
first have seen the second."""
KEPT = 1.0
"""Distance of the normal of least cost from the mean of its posterior, in standard deviations, up to which the former is kept: under few
lights it is nearer to the truth than the mean of a wide posterior."""


class Modes(NamedTuple):
    """The estimate from two modes."""

    normal: np.ndarray  # [n, 3] float32, of the more probable mode
    sigma: np.ndarray  # [n] float32, degrees: standard deviation if that mode is the right one
    spread: np.ndarray  # [n] float32, degrees: standard deviation over both modes
    probability: np.ndarray  # [n] float32, that it is the right one, 0.5…1
    excess: np.ndarray  # [n] float32, the square of the noise that the mode leaves unexplained over that of all pixels

    @classmethod
    def empty(cls, pixels: int) -> "Modes":
        """Return modes of pixels that are not judged yet."""
        return cls(np.zeros((pixels, 3), np.float32), *(np.zeros(pixels, np.float32) for _ in range(4)))

    def close_to(self, normal: np.ndarray) -> np.ndarray:
        """Return [n] bool whether these normals of least cost, [n, 3], are kept: they lie within KEPT standard deviations of the mean."""
        return angle_degrees(normal, self.normal) < KEPT * self.sigma


def find_modes(samples: Samples, model: Model, view: np.ndarray) -> np.ndarray:
    """Return the candidates of least cost over the visible hemisphere; waits for the device.
    `view`: [n, 3] unit directions to the viewer, the middle of the grid. Returns [2, n, 3] float32 unit: the best, and the best of those
    at least APART from it."""
    offsets = rings(*GRID_RINGS)
    noise = np.tile(np.array(GRID_NOISE, dtype=np.float32), (samples.pixel_count, 1))
    cost = score_normals(samples, view, offsets, noise=noise, table=model.table, bound=model.bound).cost
    sine, cosine, along, across = offsets.T
    direction = np.stack([sine * along, sine * across, cosine], axis=1)  # in the frame of tangents and view, the same for every pixel
    near = direction @ direction.T > np.cos(np.radians(APART))
    best = cost.argmin(axis=0)
    second = np.where(near[best].T, np.inf, cost).argmin(axis=0)
    return np.stack([candidates(view, offsets[chosen]) for chosen in (best, second)])


def candidates(centre: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return [n, 3] float32 the normal at an offset of `candidates.rings` from each centre, [n, 3] and [n, 4]."""
    tangent, other = tangents(centre)
    moved = offsets[:, 1:2] * centre + offsets[:, :1] * (offsets[:, 2:3] * tangent + offsets[:, 3:] * other)
    return (moved / np.linalg.norm(moved, axis=1, keepdims=True)).astype(np.float32)


def weigh(first: Posterior, second: Posterior) -> Modes:
    """Return the more probable of two modes, given the posteriors of the same pixels around either."""
    away = angle_degrees(first.normal, second.normal)
    apart = away > np.maximum(SAME * (first.sigma + second.sigma), 0.5 * APART)
    excess = np.minimum(first.excess, second.excess)
    odds = first.volume - second.volume - (first.cost - second.cost) / (2 * excess)
    other = np.where(apart, 1 / (1 + np.exp(np.clip(odds, -80, 80))), 0)
    swap = other > 0.5
    probability = np.where(swap, other, 1 - other)
    normal = np.where(swap[:, None], second.normal, first.normal)
    left = np.where(swap, second.excess, first.excess)
    sigma, rest = (np.where(swap, a, b) for a, b in ((second.sigma, first.sigma), (first.sigma, second.sigma)))
    spread = np.sqrt(probability * sigma**2 + (1 - probability) * (rest**2 + away**2))
    return Modes(normal, sigma, spread.astype(np.float32), probability.astype(np.float32), left)


def angle_degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [n] the angle between unit vectors [n, 3], degrees."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))
