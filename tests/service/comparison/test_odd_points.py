"""Scans with points that say nothing of their surface."""

import numpy as np

from service.comparison.compare import compare
from service.requests.register import CompareRequest
from tests.marks import first_short
from tests.scenes.machined_part import any_pose, scan_of, write_scan


@first_short("fault", ["no normals", "far away"])
def test_points_without_normals_and_far_ones_are_no_fault(tmp_path, part, fault):
    """A fifth of the points have normals of 0, after which nothing passed; or five points lie at 10³⁰ m, which left other poses open."""
    made, design = part
    random = np.random.default_rng(0)
    scan = scan_of(made, random, 6000, any_pose(random))
    values = (scan.normals if fault == "no normals" else scan.points).copy()
    values[:1200 if fault == "no normals" else 5] = 0 if fault == "no normals" else 1e30
    scan = scan._replace(normals=values) if fault == "no normals" else scan._replace(points=values)
    result = compare(CompareRequest(scan=write_scan(tmp_path / "scan.ply", scan), design=design, out=tmp_path / "out", device="cpu",
                                    tolerance_m=(-1e-4, 1e-4)))
    assert result.passed and result.warnings == ()
