"""A scan that shows one side of a part, most of which are planes that face one way."""

import json

import numpy as np
import pytest

from service.comparison.compare import compare
from service.requests.register import CompareRequest
from tests.scenes.machined_part import any_pose, scan_of, write_scan


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_part_that_is_seen_from_above_comes_to_lie_on_its_design(tmp_path, part, seed):
    """The flanks of rib and hollow alone tell the place along the plate: what stood off of them had no weight, and two of three failed, by
    up to .9 mm."""
    made, design = part
    random = np.random.default_rng(seed)
    pose = any_pose(random)
    scan = scan_of(made, random, 15_000, pose, lambda points, normals: normals[:, 2] < 0.97 * np.linalg.norm(normals, axis=1))
    found = compare(CompareRequest(scan=write_scan(tmp_path / "scan.ply", scan), design=design, out=tmp_path / "out", device="cpu",
                                   tolerance_m=(-1e-4, 1e-4), least_seen=0.2))
    placed = np.array(json.loads(found.report_path.read_text())["placement"]["design_from_scan"]) @ pose
    ends = np.array([[0.04, 0.025, 0, 1], [-0.04, -0.025, 0, 1]])
    assert np.abs(ends @ placed.T - ends).max() < 1e-4  # a tenth of the distance of points; two motions are open, as 5 % of the points tell
    assert found.passed
