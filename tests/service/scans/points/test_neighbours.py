"""The search of nearest points that move: the same as a search of all, in every step."""

import numpy as np
import pytest

from service.scans.points.neighbours import NearestWithin, Neighbours
from service.scans.points.rigid import applied, moved


@pytest.mark.parametrize("within", [0.02, 0.2, 3.0])
def test_moving_points_have_the_nearest_of_all(within):
    rng = np.random.default_rng(5)
    tree, points = Neighbours(rng.uniform(size=(2000, 3))), rng.uniform(-1, 2, size=(400, 3))
    search, pose = NearestWithin(tree, len(points)), np.eye(4)
    for step in range(12):
        pose = moved(rng.normal(scale=0.05 / (1 + step), size=6), np.full(3, 0.5), pose)
        rows = slice(None, None, 1 + step % 3)
        index, apart = search.search(applied(pose, points[rows]), rows, within)
        expected, distance = tree.nearest(applied(pose, points[rows]))
        near = distance[:, 0] < within
        assert (np.isfinite(apart) == near).all()
        assert (index[near] == expected[near, 0]).all() and (apart[near] == distance[near, 0]).all()
