"""Scans of a large place whose points are as far apart as its details are large: edges place it, and it is not taken for symmetric."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.site_scene import distance, look, looking, make_scene
from stage.camera import Camera
from stage.scans.fine import fit
from stage.scans.pairs import prepare
from stage.scans.registration import RegistrationOptions, register
from stage.scans.rigid import inverse, step_between
from stage.scans.scan import Scan

SIGMA = 1e-3
EYES = [((-3.0, 2.0, 0.5), (2.0, 1.0, 3.0)), ((-1.0, 2.2, -1.0), (3.0, 1.0, 2.0))]


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    """Pixels of 8 cm at 6 m."""
    scene, found = make_scene(), []
    camera = Camera(projection="perspective", resolution=(150, 120), focal_px=(80.0, 80.0))
    for number, (eye, target) in enumerate(EYES):
        pose = looking(np.array(eye), np.array(target))
        true = look(scene, camera, pose)
        mask = true > 0
        exact = camera.points(-true)[mask].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        assert distance(scene, exact[::20]).max() < 2e-6  # of single precision at 20 m
        depth = true + SIGMA * np.random.default_rng(number).standard_normal(true.shape)
        points = camera.points(-depth)[mask].astype(np.float32)
        found.append(Scan(name=str(number), path=Path("scan"), points=points, sigma=np.full(len(points), SIGMA, np.float32),
                          sigma_source="measured", normals=None, normals_source="unknown", colours=None, confidence=None,
                          origin=np.zeros(3), camera=camera, pixels=np.flatnonzero(mask), pose=pose, pose_covariance=None, maps=None))
    return found


def test_a_courtyard_of_coarse_points_is_placed(scans):
    found = register(scans, [scan.pose for scan in scans], RegistrationOptions())
    first, second = (found.poses[number] @ inverse(scan.pose) for number, scan in enumerate(scans))
    step = step_between(inverse(first) @ second, np.array([2.0, 1.0, 2.0]))
    assert np.linalg.norm(step[3:]) < 10e-3 and np.degrees(np.linalg.norm(step[:3])) < 0.2


def test_edges_do_not_count_as_wrong_normals(scans):
    """By how much the least determined direction is surer than normals alone would make it, with edges and without."""
    a, b = (prepare(scan, cell_m=0.2) for scan in scans)
    assert scans[0].pose is not None and scans[1].pose is not None
    found = fit(a.fine, b.fine, inverse(scans[0].pose) @ scans[1].pose, [0.3, 0.15])
    assert found is not None
    least = [float(np.linalg.eigvals(np.linalg.solve(bend, found.normal)).real.min()) for bend in (found.bend, found.even_bend)]
    assert least[1] > 3 * least[0]
