"""The side of the scanner, where normals of the files are flipped and where surfaces are hollow."""

import numpy as np
import pytest

from service.scans.viewpoints import find_viewpoints


def cap(*, hollow: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points of a third of a ball around the origin that is seen from above and their normals: of its top, or of a bowl, its bottom."""
    normals = np.random.default_rng(5).normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] > 0.4]
    return (normals * [1, 1, -1], normals * [-1, -1, 1]) if hollow else (normals, normals.copy())


@pytest.mark.parametrize("shift", [[0, 0, -3], pytest.param([3, 0, 0], marks=pytest.mark.long)],
                         ids=["frame of the scanner", "origin beside"])
def test_flipped_normals_do_not_put_the_scanner_behind(shift):
    points, normals = cap(hollow=False)
    points = points + shift
    found = find_viewpoints([points] * 3, [-normals] * 3)
    assert found.place is None and "the normals look flipped" in found.reason
    right = find_viewpoints([points] * 3, [normals] * 3)
    assert right.place is not None and (right.place[:, 2] > points[:, 2].max() - 0.1).all()


@pytest.mark.long
def test_normals_of_a_bowl_before_its_scanner_are_not_accused():
    """Its rims turn towards the scanner, as those of a body do that is seen from behind, but the scanner is at the origin."""
    points, normals = cap(hollow=True)
    points = points - [0, 0, 3.0]
    found = find_viewpoints([points] * 3, [normals] * 3)
    assert found.place is not None and (found.place[:, 2] > points[:, 2].max()).all()
