"""Whether a scan lies beside the others, where parts stand in front of each other."""

import numpy as np
import pytest

from service.scans.fusion.misplaced import Readings, Sample, place_scans

VOXEL, SIGMA = 0.025, 0.5e-3
POINTS, AGREEING = 1000, 0.8
"""Points of the scan, and the part of them that some other scan sees too; what it sees at the rest stands in front of them."""


def statue(displacement):
    """A scan of half a sphere, and five others: two from near, which see most of it, and three from afar, from which other parts hide most.

    The scan lies beside its place by a displacement, [3] metres.
    """
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(POINTS, 3))
    normals[:, 2] = np.abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    one = Sample(0.3 * normals + displacement, normals, np.full(POINTS, SIGMA**2))
    few = Sample(one.points[:10], one.normals[:10], one.variance[:10])  # too few to tell where the others lie
    seen = rng.random(POINTS) < AGREEING
    readings = [Readings(np.zeros(0, np.int64), np.zeros(0, np.float32), np.zeros(0, np.float32))]
    for share in (0.6, 0.6, 0.2, 0.2, 0.2):
        same = seen & (rng.random(POINTS) < share)
        apart = np.where(same, SIGMA * rng.normal(size=POINTS), -rng.uniform(0.03, 0.2, POINTS)) + normals @ displacement
        readings.append(Readings(np.arange(POINTS), apart.astype(np.float32), np.full(POINTS, SIGMA, np.float32)))
    return [one, *[few] * 5], readings


def test_a_scan_that_others_hide_is_not_misplaced():
    placing = place_scans(*statue(np.zeros(3)), VOXEL)[0]
    assert placing.compared == POINTS and not placing.misplaced
    assert placing.displacement_m < 2 * SIGMA  # that of the points that agree is a tenth of SIGMA; hidden ones weigh next to nothing


@pytest.mark.parametrize("direction", np.eye(3), ids="xyz")
def test_a_scan_that_lies_beside_its_place_is(direction):
    """The hidden points, which are most of what the scans from afar see, do not tell by how much."""
    assert place_scans(*statue(1.6 * VOXEL * direction), VOXEL)[0].misplaced
