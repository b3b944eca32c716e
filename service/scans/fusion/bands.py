"""Values on a mesh as a sum of bands, each what they vary by over lengths between two: means over cells of space that double."""

from itertools import pairwise

import numpy as np

FINEST_PIXELS = 4.0
"""Shortest length of a band in pixels: below it a depth between pixels is a chord, and a normal of it says nothing."""
BANDS = 6
"""Lengths of bands, each twice the one before."""
FAINT = 1e-9
"""Weight of a vertex that does not count, so that a cell of such vertices alone still has a mean."""


class Bands:
    """Means over cells whose sides double, between whose middles they are linear, weighted by areas.

    A cell holds six means, for surfaces that face along the axes and against them, so that the two sides of a sheet do not mix.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, area: np.ndarray, pixel_m: float) -> None:
        """Create the cells of a mesh of points [V, 3] and unit normals [V, 3], whose vertices have areas [V], square metres.

        Neighbouring pixels lie pixel_m apart on the surface.
        """
        self._points, self._area = points, area
        self._facing = normals**2
        self._side = np.where(normals < 0, 1, 0) + np.array([0, 2, 4])
        self._lengths = [FINEST_PIXELS * pixel_m * 2**k for k in range(BANDS)]

    def averaged(self, values: np.ndarray, length: float, counts: np.ndarray | None = None) -> np.ndarray:
        """Return values [V, k] averaged over about a length, metres; `counts` [V] is by how much each vertex counts, 0…1."""
        local = self._points / length - 0.5
        low = np.floor(local).astype(np.int64)
        part = local - low
        low -= low.min(axis=0)
        size = low.max(axis=0) + 2
        strides = np.array([1, size[0], size[0] * size[1]])
        corners = np.array(list(np.ndindex(2, 2, 2)))
        cells, own = np.unique(low @ strides, return_inverse=True)
        around, number = np.unique(cells[:, None] + corners @ strides, return_inverse=True)
        number = number.reshape(len(cells), len(corners)) * 6
        weights, places = [], []
        for column, corner in enumerate(corners):
            share = np.prod(np.where(corner, part, 1 - part), axis=1)
            place = number[own.ravel(), column]
            for axis in range(3):
                weights.append(share * self._facing[:, axis])
                places.append(place + self._side[:, axis])
        count = 6 * len(around)
        area = self._weights(counts)

        def summed(given: np.ndarray) -> np.ndarray:
            return np.sum([np.bincount(cells, weight * given, count) for cells, weight in zip(places, weights, strict=True)], axis=0)

        total = np.maximum(summed(area), np.finfo(np.float64).tiny)
        out = np.zeros_like(values)
        for column in range(values.shape[1]):
            mean = summed(area * values[:, column]) / total
            for cells, weight in zip(places, weights, strict=True):
                out[:, column] += weight * mean[cells]
        return out

    def of(self, values: np.ndarray, counts: np.ndarray) -> list[np.ndarray]:
        """Return values [V, k] as a sum of bands, the finest first; `counts` [V] is by how much each vertex counts, 0…1."""
        smooth = [values, *(self.averaged(values, length, counts) for length in self._lengths)]
        return [one - other for one, other in pairwise(smooth)] + [smooth[-1]]

    def variance(self, values: np.ndarray, counts: np.ndarray) -> float:
        """Return the mean square of vectors [V, k] over vertices that count by `counts` [V]."""
        return float(np.average((values**2).sum(axis=1), weights=self._weights(counts)))

    def _weights(self, counts: np.ndarray | None) -> np.ndarray:
        return self._area if counts is None else self._area * np.maximum(counts, FAINT)
