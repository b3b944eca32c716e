"""Poses that drift from scan to scan, as those of a turntable whose step is declared wrong."""

import numpy as np
import pytest

from service.errors import RequestError
from service.scans.fusion.misplaced import Readings, Sample
from service.scans.fusion.pose_drift import pose_drift
from tests.scenes.register import fuse_scans
from tests.scenes.statue import Shot, write_scans
from tests.scenes.turntable import figure, pose, turntable

SCANS, POINTS, SIGMA = 8, 300, 0.5e-3
NONE = np.zeros((SCANS, 3))
DRIFT = np.arange(SCANS)[:, None] * np.radians([0.0, 0.3, 0.0])


def around(turned, moved):
    """Scans of an ellipsoid that all see each other, each turned, [scans, 3] radians, and moved, [scans, 3] metres, from its place; in
    closed form, to the first order of both."""
    random = np.random.default_rng(2)
    unit = random.normal(size=(SCANS, POINTS, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    axes = np.array([0.1, 0.2, 0.15])
    points, normals = unit * axes, unit / axes
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    samples = [Sample(*pair, np.full(POINTS, SIGMA**2)) for pair in zip(points, normals, strict=True)]
    readings = []
    for other in range(SCANS):
        apart = np.cross((turned - turned[other])[:, None], points) + (moved - moved[other])[:, None]
        distance = (apart * normals).sum(axis=-1) + SIGMA * random.normal(size=(SCANS, POINTS))
        distance[other] = np.nan
        at = np.flatnonzero(np.isfinite(distance))
        readings.append(Readings(at, distance.ravel()[at].astype(np.float32), np.full(len(at), SIGMA, np.float32)))
    return samples, readings


def test_the_turn_of_a_step_is_found():
    found = pose_drift(*around(DRIFT, NONE))
    np.testing.assert_allclose(found.turn, DRIFT[1], atol=np.radians(0.003))  # three standard errors of 17 000 readings at ten per cent


@pytest.mark.parametrize("kind", ["right", "one is off", "some error each"])
def test_other_errors_of_poses_are_no_drift(kind):
    random = np.random.default_rng(3)
    moved = {"right": NONE, "one is off": 3e-3 * np.eye(SCANS, 3, -3), "some error each": 3e-4 * random.normal(size=(SCANS, 3))}[kind]
    assert pose_drift(*around(NONE, moved)) is None


def file_of(folder, count, sigma, *, larger=1.01):
    """Scans of the figure at even steps of a turntable, whose declared steps are larger."""
    angles = 360 / count * np.arange(count)
    views = turntable(figure, [*angles], rows=72, sigma=sigma)
    shots = [Shot(view.depth, view.true_depth, view.mask, pose(larger * angle), view.camera.focal_px[0], view.depth.shape)
             for view, angle in zip(views, angles, strict=True)]
    return write_scans(folder, shots, sigma=sigma)


@pytest.mark.long
def test_a_step_of_the_turntable_that_is_declared_too_large_is_named(tmp_path):
    found = fuse_scans(file_of(tmp_path, 24, 1e-3), tmp_path / "out")
    warning, = (warning for warning in found.warnings if "poses turn by 15.15°" in warning)
    assert "surfaces by some 15" in warning
    assert all(scan["fused"] for scan in found.facts["scans"])


@pytest.mark.long
def test_a_step_that_makes_scans_seem_misplaced_is_refused(tmp_path):
    with pytest.raises(RequestError, match=r"poses turn by 15\.75° in the median, and the surfaces by some 15"):
        fuse_scans(file_of(tmp_path, 24, 1e-3, larger=1.05), tmp_path / "out")
