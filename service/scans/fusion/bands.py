"""Values on a mesh as a sum of bands, each what they vary by over lengths between two: means over cells of space that double."""

from itertools import pairwise

import numpy as np
from scipy.sparse import csr_array

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
        self._side = (np.where(normals < 0, 1, 0) + np.array([0, 2, 4])).astype(np.int32)
        self._lengths = [FINEST_PIXELS * pixel_m * 2**k for k in range(BANDS)]

    def averaged(self, values: np.ndarray, length: float, counts: np.ndarray | None = None) -> np.ndarray:
        """Return values [V, k] averaged over about a length, metres; `counts` [V] is by how much each vertex counts, 0…1."""
        mixed = self._mixed(length)
        area = self._weights(counts)[:, None]
        total = np.maximum(mixed.T @ area, np.finfo(np.float64).tiny)
        return np.asarray(mixed @ (mixed.T @ (area * values) / total))

    def _mixed(self, length: float) -> csr_array:
        """Return the matrix [V, means] by which means over cells of a length mix at a vertex: eight cells, three sides of each."""
        local = self._points / length - 0.5
        low = np.floor(local).astype(np.int64)
        part = local - low
        low -= low.min(axis=0)
        size = low.max(axis=0) + 2
        strides = np.array([1, size[0], size[0] * size[1]])
        corners = np.array(list(np.ndindex(2, 2, 2)))
        cells, own = np.unique(low @ strides, return_inverse=True)
        around, number = np.unique(cells[:, None] + corners @ strides, return_inverse=True)
        places = 6 * number.reshape(len(cells), 1, 8).astype(np.int32)[own.ravel()] + self._side[:, :, None]
        along = [np.stack([1 - part[:, axis], part[:, axis]], axis=1) for axis in range(3)]
        share = (along[0][:, :, None, None] * along[1][:, None, :, None] * along[2][:, None, None, :]).reshape(-1, 1, 8)
        return csr_array(((share * self._facing[:, :, None]).ravel(), places.ravel(), np.arange(0, places.size + 1, 24)),
                         shape=(len(part), 6 * len(around)))

    def of(self, values: np.ndarray, counts: np.ndarray) -> list[np.ndarray]:
        """Return values [V, k] as a sum of bands, the finest first; `counts` [V] is by how much each vertex counts, 0…1."""
        smooth = [values, *(self.averaged(values, length, counts) for length in self._lengths)]
        return [one - other for one, other in pairwise(smooth)] + [smooth[-1]]

    def variance(self, values: np.ndarray, counts: np.ndarray) -> float:
        """Return the mean square of vectors [V, k] over vertices that count by `counts` [V]."""
        return float(np.average((values**2).sum(axis=1), weights=self._weights(counts)))

    def _weights(self, counts: np.ndarray | None) -> np.ndarray:
        return self._area if counts is None else self._area * np.maximum(counts, FAINT)
