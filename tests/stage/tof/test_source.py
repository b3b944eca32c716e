"""A light source beside the camera: range from path, against points that are placed and paths that are measured."""

import json

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.errors import ManifestError
from stage.tof.raw_frames import read_source
from stage.tof.source import SourcePath

PERSPECTIVE = Camera(projection="perspective", resolution=(16, 12), focal_px=(14, 15))
FLAT = Camera(projection="orthographic", resolution=(16, 12), pixel_size_m=0.02)
SOURCE = (0.31, -0.12, 0.07)


def lines_of_sight(camera):
    x, y = camera.plane_coordinates()
    if camera.projection == "orthographic":
        return np.stack([x, y, 0 * x], axis=-1), np.broadcast_to([0.0, 0.0, -1.0], (*x.shape, 3))
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
    return np.zeros_like(rays), rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@pytest.mark.parametrize("camera", [PERSPECTIVE, FLAT], ids=["perspective", "orthographic"])
def test_range_of_a_measured_path(camera):
    rng, (begin, ray) = np.random.default_rng(1), lines_of_sight(camera)
    truth = rng.uniform(0.2, 6.0, (12, 16))
    points = begin + truth[..., None] * ray
    leg = np.linalg.norm(points - SOURCE, axis=-1)
    path = SourcePath.of(camera, SOURCE)
    np.testing.assert_allclose(path.source_range_m(truth), leg, rtol=1e-12)
    np.testing.assert_allclose(path.half_path_m(truth), (truth + leg) / 2, rtol=1e-12)
    found, per_metre = path.range_of((truth + leg) / 2)
    np.testing.assert_allclose(found, truth, rtol=1e-10)
    step = 1e-6  # a central difference: its error is step² times a third derivative of the order of one
    np.testing.assert_allclose(per_metre, (path.range_of((truth + leg) / 2 + step)[0] - path.range_of((truth + leg) / 2 - step)[0])
                               / (2 * step), rtol=1e-6)


def test_a_path_shorter_than_to_the_source_has_no_point():
    path = SourcePath.of(PERSPECTIVE, SOURCE)
    assert (path.range_of(np.full((12, 16), 0.4 * np.linalg.norm(SOURCE)))[0] <= 0).all()


def test_a_source_at_the_camera_changes_nothing():
    assert SourcePath.of(PERSPECTIVE, None) is None and SourcePath.of(PERSPECTIVE, (0.0, 0.0, 0.0)) is None


def test_frames_share_one_source(tmp_path):
    frames = [{"image": f"{k}.npy", "tof": {"type": "cw", "modulation_hz": 2e7, "reference_phase_rad": k, "source_m": [0.05 * k, 0, 0]}}
              for k in range(2)]
    (tmp_path / "capture.json").write_text(json.dumps({"schema": "relit.capture/1", "name": "two", "frames": frames,
                                                       "camera": PERSPECTIVE.model_dump(mode="json", exclude_none=True)}))
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", np.zeros((12, 16)))
    with pytest.raises(ManifestError, match=r"source_m: 0.npy and 1.npy have different sources"):
        read_source(Capture.open(tmp_path))
