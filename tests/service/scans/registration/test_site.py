"""Scans of a large place whose points are as far apart as its details are large, and of its statues from near, in squares of pixels."""

import numpy as np
import pytest

from benchmarks.site_scene import distance, look, make_scene
from service.scans.points import cloud
from service.scans.points.rigid import inverse, moved, step_between
from service.scans.points.scan import Scan
from service.scans.registration.fine import fit
from service.scans.registration.pairs import PairState, prepare, refine
from stage.capture.camera import Camera
from tests.reference.projector import look_at
from tests.scenes.register import register, scan_with

SIGMA = 1e-3
EYES = [((-3.0, 2.0, 0.5), (2.0, 1.0, 3.0)), ((-1.0, 2.2, -1.0), (3.0, 1.0, 2.0))]


def scan_of(number: int, camera: Camera, pose: np.ndarray, sigma: float, range_m: float = np.inf) -> Scan:
    """Return a scan of the courtyard, whose points are checked to lie on it."""
    scene = make_scene()
    true = look(scene, camera, pose)
    mask = (true > 0) & (true < range_m)
    exact = camera.points(-true)[mask].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    assert distance(scene, exact[::20]).max() < 2e-6  # of single precision at 20 m
    depth = true + sigma * np.random.default_rng(number).standard_normal(true.shape)
    points = camera.points(-depth)[mask].astype(np.float32)
    return scan_with(points, sigma, name=str(number), camera=camera, pixels=np.flatnonzero(mask), pose=pose)


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    """Pixels of 8 cm at 6 m."""
    camera = Camera(projection="perspective", resolution=(150, 120), focal_px=(80.0, 80.0))
    return [scan_of(number, camera, look_at(eye, target), SIGMA) for number, (eye, target) in enumerate(EYES)]


def test_poses_of_squares_of_pixels_are_as_sure_as_they_say(monkeypatch):
    """Two scans of 120 000 pixels of a statue of balls, in squares of 5 pixels. The mean of such squares lies behind the balls, and made
    the poses wrong by 8 of their standard deviations. χ² of six numbers exceeds 30 once in 25 000 times."""
    monkeypatch.setattr(cloud, "MOST_POINTS", 5000)
    camera, statue = Camera(projection="perspective", resolution=(400, 320), focal_px=(700.0, 700.0)), make_scene().statues[5]
    eyes = [statue + 1.3 * np.array([np.cos(turn), 0.2, np.sin(turn)]) for turn in (0.0, 0.8)]
    near = [scan_of(number, camera, look_at(eye, statue), 1e-4, 2.2) for number, eye in enumerate(eyes)]
    a, b = (prepare(scan, cell_m=0.02) for scan in near)
    assert len(a.fine.points) < 5000
    assert near[0].pose is not None and near[1].pose is not None
    true = inverse(near[0].pose) @ near[1].pose
    pair = refine(a, b, moved(np.array([0.002, -0.002, 0.001, 0.003, -0.003, 0.002]), np.array([0, 0, -1.3]), true), numbers=(0, 1),
                  cell_m=0.02, least_overlap=0.1)
    assert pair.state is PairState.JOINED and pair.fit is not None, pair.reason
    step = step_between(pair.fit.pose @ inverse(true), pair.fit.pivot)
    assert np.linalg.norm(step[3:]) < 0.03e-3  # pixels of 1.9 mm, noise of 0.1 mm
    assert step @ pair.fit.information @ step < 30


@pytest.mark.long
def test_a_courtyard_of_coarse_points_is_placed(scans):
    found = register(scans, [scan.pose for scan in scans])
    first, second = (found.poses[number] @ inverse(scan.pose) for number, scan in enumerate(scans))
    step = step_between(inverse(first) @ second, np.array([2.0, 1.0, 2.0]))
    assert np.linalg.norm(step[3:]) < 10e-3 and np.degrees(np.linalg.norm(step[:3])) < 0.2


@pytest.mark.long
def test_edges_do_not_count_as_wrong_normals(scans):
    """By how much the least determined direction is surer than normals alone would make it, with edges and without."""
    a, b = (prepare(scan, cell_m=0.2) for scan in scans)
    assert scans[0].pose is not None and scans[1].pose is not None
    found = fit(a.fine, b.fine, inverse(scans[0].pose) @ scans[1].pose, [0.3, 0.15])
    assert found is not None
    least = [float(np.linalg.eigvals(np.linalg.solve(bend, found.normal)).real.min()) for bend in (found.bend, found.even_bend)]
    assert least[1] > 3 * least[0]
