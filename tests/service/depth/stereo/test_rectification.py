"""Rectification of known rigs: rows agree, disparity follows f B / Z, and images that are rectified already stay as they are."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.depth.stereo.rectification import rectify
from stage.capture.camera import Camera, OtherCamera
from stage.errors import ManifestError
from tests.reference import projector as reference
from tests.scenes.depth import entry_of
from tests.scenes.stereo import CAMERA, OTHER, POSE


def turned(axis, degrees, place):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix(), place
    return pose


def rig(pose, other=OTHER):
    return (Camera(projection="perspective", **entry_of(CAMERA)),
            OtherCamera(name="right", **entry_of(other), camera_from_other=np.asarray(pose).tolist()))


RIGS = {
    "beside, verged": POSE, "to the left": reference.look_at((-0.2, 0.01, -0.01), (0.0, 0.0, -1.0)),
    "above": turned("x", -8, (0.0, 0.15, 0.0)), "below and turned about its axis": turned("z", 25, (0.02, -0.1, 0.01)),
}


@pytest.mark.parametrize("name", RIGS)
def test_a_point_lies_on_one_row_and_its_disparity_is_that_of_its_depth(name):
    camera, other = rig(RIGS[name])
    found = rectify(camera, other, where="capture.json: other_cameras[0]")
    depth = np.random.default_rng(0).uniform(0.6, 2.0, (camera.height, camera.width))
    points = reference.pixel_rays(CAMERA) * depth[..., None]
    pose = np.array(other.camera_from_other)
    own = (points - pose[:3, 3]) @ pose[:3, :3]
    turned_own = own @ found.rectified_from_other.T
    x_right, y_right = (found.focal_px * turned_own[..., i] / turned_own[..., 2] - start
                        for i, start in ((0, found.right.left), (1, found.right.top)))
    x, y, ahead = found.positions(slice(0, camera.height))
    assert np.abs(y - y_right).max() < 1e-6  # undoing the lens by fixed-point iteration leaves 1e-9 of a pixel
    disparity = x - x_right + found.offset_px
    assert np.abs(disparity - found.focal_px * found.baseline_m / (depth * ahead)).max() < 1e-6
    assert disparity.min() > 0  # the reference camera is the left one wherever the other stands
    inside = (x > -0.01) & (y > -0.01) & (x < found.left.width - 0.99) & (y < found.left.height - 0.99)
    assert inside.mean() > 0.995


def test_rectified_images_stay_as_they_are():
    pixels = np.random.default_rng(1).random((24, 32)).astype(np.float32)
    camera = Camera(projection="perspective", resolution=(32, 24), focal_px=(40.0, 40.0), principal_px=(15.3, 12.8))
    other = OtherCamera(name="right", resolution=(32, 24), focal_px=(40.0, 40.0), principal_px=(17.1, 12.8),
                        camera_from_other=turned("x", 0, (0.1, 0, 0)).tolist())
    found = rectify(camera, other, where="")
    for is_other in (False, True):
        image, seen = found.rows_of(pixels, other=is_other)
        top, left = (round(at) for at in ((0.5 - 12.8) - found.left.top,
                                               (0.5 - (17.1 if is_other else 15.3)) - (found.right if is_other else found.left).left))
        box = np.s_[top:top + 24, left:left + 32]
        assert seen[box].all() and seen.sum() == seen[box].sum()
        assert np.abs(image[box] - pixels).max() < 1e-5  # float32 places


def test_what_a_camera_does_not_see_is_told():
    camera, other = rig(POSE)
    image = np.ones((CAMERA.height, CAMERA.width), np.float32)
    image[100, 200] = np.nan
    values, seen = rectify(camera, other, where="").rows_of(image, other=False)
    assert np.abs(values[seen] - 1).max() < 1e-5 and 0 < (~seen).sum() < 0.2 * seen.size
    assert (~seen[60:160, 120:280]).sum() >= 4


@pytest.mark.parametrize(("pose", "says"), [
    (turned("y", 0, (0, 0, 0)), "without a baseline"),
    (turned("y", 0, (120.0, 0, 0)), "give the translation in metres"),
    (turned("y", 0, (0.005, 0, -0.2)), "one camera stands before the other"),
    (turned("y", 180, (0.2, 0, 0)), "degrees apart"),
    (turned("y", 75, (0.2, 0, 0)), "directions"),
])
def test_rigs_that_cannot_be_are_refused(pose, says):
    with pytest.raises(ManifestError, match=says) as error:
        rectify(*rig(pose), where="capture.json: other_cameras[0]")
    assert str(error.value).startswith("capture.json: other_cameras[0].camera_from_other: ")
