"""Measured lights into manifests: what changes, what stays, and captures that do not belong together."""

import numpy as np
import pytest

from service.calibrate.solvers.apply import as_direction, as_position, check_same_setup, lit_frames, with_brightness, with_lights
from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.errors import ManifestError
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, write_capture

FAR = DistantLight(type="distant", direction=(0, 0, 1), irradiance=(1, 2, 3))
NEAR = PointLight(type="point", position_m=(0, 0, 2), intensity=(1, 2, 3), axis=(0, 0, -1), anisotropy=1.5)


def test_lights_change_place_and_keep_the_rest():
    far = as_direction(FAR, np.array([0.6, 0, 0.8]))
    assert far.direction == pytest.approx((0.6, 0, 0.8)) and far.irradiance == FAR.irradiance
    near = as_position(NEAR, np.array([1.0, 0, 1]), np.zeros(3))
    assert near == NEAR.model_copy(update={"position_m": (1.0, 0.0, 1.0)})


def test_a_light_that_changes_its_kind():
    """E = I/d²: a far light of irradiance E becomes a near one of intensity E·d² at the place it was seen from."""
    near = as_position(FAR, np.array([0.0, 0, 3]), np.array([0.0, 0, 1]))
    assert near.type == "point" and near.intensity == pytest.approx((4, 8, 12))
    far = as_direction(NEAR, np.array([0.0, 0, 1]))
    assert far.type == "distant" and far.irradiance == (1, 1, 1)  # its distance is not known
    assert with_brightness(NEAR, np.array([7, 8, 9])).intensity == (7, 8, 9)
    assert with_brightness(FAR, np.array([7, 8, 9])).irradiance == (7, 8, 9)


def test_frames_of_other_kinds_stay_and_failed_ones_go(tmp_path):
    capture_folder = write_capture(tmp_path, make_scene(4, 4))
    edit_frame(capture_folder, 1, light={"type": "off"})
    capture = Capture.open(capture_folder)
    assert [lit.number for lit in lit_frames(capture)] == [0, 2, 3]
    manifest = with_lights(capture, [FAR, None, NEAR])
    assert [frame.image for frame in manifest.frames] == ["000.exr", "001.exr", "003.exr"]
    assert [frame.light.type for frame in manifest.frames] == ["distant", "off", "point"]
    assert manifest.model_copy(update={"frames": ()}) == capture.manifest.model_copy(update={"frames": ()})


def test_captures_that_do_not_belong_together(tmp_path):
    one, other = (write_capture(tmp_path / name, make_scene(4, 3)) for name in ("one", "other"))
    check_same_setup(Capture.open(one), Capture.open(other))
    turned = np.eye(4)
    for x, folder in ((0.0, one), (0.1, other)):
        turned[0, 3] = x
        edit_manifest(folder, camera={"projection": "orthographic", "resolution": [4, 4], "world_from_camera": turned.tolist()})
    with pytest.raises(ManifestError, match=r"world_from_camera: differs"):
        check_same_setup(Capture.open(one), Capture.open(other))
    edit_manifest(other, camera={"projection": "perspective", "resolution": [4, 4], "focal_px": [9, 9]})
    with pytest.raises(ManifestError, match=r"camera\.projection: differs"):
        check_same_setup(Capture.open(one), Capture.open(other))
