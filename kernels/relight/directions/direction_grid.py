"""A fixed grid of directions, over which the light of any frame is spread: a surface is shaded once for each direction of the grid, and
every frame is a weighted sum of the results.

The directions lie on rings about +y, as far apart along a ring as the rings are. A sample of light goes to the 16 directions around it,
four rings and four directions of each, with the weights of cubic convolution. Its sum with the responses of a surface is then their cubic
interpolation, which is exact for responses that are quadratic between the directions.

Source: Keys, "Cubic convolution interpolation for digital image processing", IEEE TASSP 29(6), 1981, with a = -1/2; rings as in reduced
Gaussian grids, Hortal and Simmons, Monthly Weather Review 119, 1991.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

PITCH_DEGREES = 4.5
"""Angle between neighbouring directions. With it, broad light has half the error of 1024 samples of its own or less, on surfaces of any
roughness (docs/relight_methods.md)."""
LEAST_COLUMNS = 16
"""Least number of directions of a ring: with the four that its length asks for, they are too far apart in azimuth for a cubic."""


class DirectionGrid(NamedTuple):
    """Directions on rings about +y."""

    direction: np.ndarray  # [D, 3] float64 unit vectors, ring after ring from +y to -y
    columns: np.ndarray  # [rings] number of directions of each ring
    first: np.ndarray  # [rings] index of the first direction of each ring


@cache
def direction_grid() -> DirectionGrid:
    """Return the grid of PITCH_DEGREES."""
    rings = round(180 / PITCH_DEGREES)
    polar = np.pi * (np.arange(rings) + 0.5) / rings
    columns = np.maximum(np.rint(2 * rings * np.sin(polar)).astype(int), LEAST_COLUMNS)
    first = np.concatenate([[0], np.cumsum(columns)[:-1]])
    ring = np.repeat(np.arange(rings), columns)
    azimuth = 2 * np.pi * (np.arange(len(ring)) - first[ring] + 0.5) / columns[ring]
    sine = np.sin(polar[ring])
    direction = np.stack([sine * np.sin(azimuth), np.cos(polar[ring]), -sine * np.cos(azimuth)], axis=1)
    return DirectionGrid(direction, columns, first)


def spread(samples: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """Spread samples of light in unit directions [n, 3] over the directions of the grid.

    Returns:
        [D, channels] float64 energy of each direction; its sum is that of the samples. Directions beside a bright sample may have a
        negative one.
    """
    grid = direction_grid()
    rings = len(grid.columns)
    polar = np.arccos(np.clip(samples[:, 1], -1, 1)) * (rings / np.pi) - 0.5
    turn = np.arctan2(samples[:, 0], -samples[:, 2]) / (2 * np.pi)
    ring = np.floor(polar) + np.arange(-1, 3)[:, None]
    over = (ring < 0) | (ring >= rings)  # beyond a pole, a ring continues on the other side
    ring = np.where(ring < 0, -1 - ring, np.where(over, 2 * rings - 1 - ring, ring)).astype(int)
    columns = grid.columns[ring]
    along = (turn + 0.5 * over) * columns - 0.5
    column = (np.floor(along)[None] + np.arange(-1, 3)[:, None, None]).astype(int) % columns
    at = (grid.first[ring] + column).reshape(-1)
    weight = _cubic(along - np.floor(along)) * _cubic(polar - np.floor(polar))
    return np.stack([np.bincount(at, weights=(weight * amount).reshape(-1), minlength=len(grid.direction)) for amount in energy.T], axis=1)


def _cubic(fraction: np.ndarray) -> np.ndarray:
    """Return the weights [4, …] of the four places around each fraction […] of the way from the second to the third."""
    x = fraction
    return np.stack([((2 - x) * x - 1) * x, (3 * x - 5) * x * x + 2, ((4 - 3 * x) * x + 1) * x, (x - 1) * x * x]) / 2
