"""Nearest points by the k-d tree of small_gicp, which `pip install 'relit[scans]'` installs."""

from importlib.util import find_spec

import numpy as np


def neighbours_are_installed() -> bool:
    """Return whether small_gicp is installed."""
    return find_spec("small_gicp") is not None
MOST_CELLS = 1 << 20
"""About the most cells of the grid that tells which points are far from all others."""


class Neighbours:
    """A k-d tree of points."""

    def __init__(self, points: np.ndarray) -> None:
        """Build the tree of points [n, 3], metres."""
        from small_gicp import KdTree

        self._count = len(points)
        self._points, self._low = points, points.min(axis=0)
        self._extent = points.max(axis=0) - self._low
        self._near: dict[float, np.ndarray] = {}  # by the side of a cell, whether a point is in it or beside it
        self._tree = KdTree(np.ascontiguousarray(points, dtype=np.float64))

    def nearest(self, points: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices [m, count] int64 of the nearest points of the tree to points [m, 3], nearest first, and their distances."""
        index, squared = self._tree.batch_knn_search(np.ascontiguousarray(points, dtype=np.float64), min(count, self._count))
        return index.astype(np.int64), np.sqrt(squared)

    def may_be_near(self, points: np.ndarray, within: float) -> np.ndarray:
        """Return [m] bool: False of points [m, 3] that certainly lie farther than a distance, metres, from every point of the tree.

        It takes a small part of the time of a search, which for points far away is longest.
        """
        low, extent = self._low, self._extent
        side = max(within, float(np.cbrt(np.prod(np.maximum(extent, within) / MOST_CELLS ** (1 / 3)))))
        if side not in self._near:
            there = np.zeros((extent / side).astype(np.int64) + 3, dtype=bool)  # with a border
            there[tuple((((self._points - low) / side).astype(np.int64) + 1).T)] = True
            for axis in range(3):
                ahead, behind = (np.roll(there, step, axis=axis) for step in (-1, 1))  # the border is empty along this axis
                there = there | ahead | behind
            self._near[side] = there
        there = self._near[side]
        index = np.clip(np.floor((points - low) / side) + 1, 0, np.array(there.shape) - 1).astype(np.int64)
        return np.asarray(there[tuple(index.T)])


class NearestWithin:
    """The nearest points of a tree within a distance, of points that move from search to search.

    A point that was farther away than the distance by more than it has moved since then is still too far away, and is not looked for again:
    to find that nothing is near takes longer than to find what is.
    """

    def __init__(self, tree: Neighbours, count: int) -> None:
        """Begin with `count` points of which nothing is known."""
        self._tree = tree
        self._place = np.zeros((count, 3))
        self._apart = np.zeros(count)  # metres, at that place

    def search(self, points: np.ndarray, rows: slice, within: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest point of the tree to each point, [m] int64, and its distance [m], metres; infinity beyond `within`.

        The points [m, 3] are where those of some rows are now.
        """
        moved = points - self._place[rows]
        near = np.flatnonzero(self._apart[rows] - np.sqrt((moved * moved) @ np.ones(3)) < within)
        index, apart = np.zeros(len(points), dtype=np.int64), np.full(len(points), np.inf)
        close = self._tree.may_be_near(points[near], within)
        far, near = near[~close], near[close]
        self._place[rows][far], self._apart[rows][far] = points[far], within
        if len(near):
            found, distance = self._tree.nearest(points[near])
            self._place[rows][near], self._apart[rows][near] = points[near], distance[:, 0]
            index[near], apart[near] = found[:, 0], distance[:, 0]
        apart[apart >= within] = np.inf
        return index, apart
