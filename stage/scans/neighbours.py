"""Nearest points by the k-d tree of small_gicp, which `pip install 'relit[scans]'` installs."""

from importlib.util import find_spec

import numpy as np


def neighbours_are_installed() -> bool:
    """Return whether small_gicp is installed."""
    return find_spec("small_gicp") is not None


class Neighbours:
    """A k-d tree of points."""

    def __init__(self, points: np.ndarray, *, threads: int = 1) -> None:
        """Build the tree of points [n, 3], metres; searches run on this many threads."""
        from small_gicp import KdTree

        self._count, self._threads = len(points), threads
        self._tree = KdTree(np.ascontiguousarray(points, dtype=np.float64), threads)

    def nearest(self, points: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest points of the tree, the nearest first.

        Args:
            points: [m, 3] metres.
            count: how many; no more than there are.

        Returns:
            Their indices [m, count] int64 and their distances [m, count] float64, metres.
        """
        index, squared = self._tree.batch_knn_search(np.ascontiguousarray(points, dtype=np.float64), min(count, self._count), self._threads)
        return index.astype(np.int64), np.sqrt(squared)
