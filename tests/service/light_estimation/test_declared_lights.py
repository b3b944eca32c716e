"""What frames, bases and `relit info` say of lights that are declared wrongly; right ones leave nothing to say."""

import json

import numpy as np
import pytest

from service.basis.basis import make_basis
from service.captures.info import inspect
from service.relight.relight import relight
from service.requests.basis import BasisRequest
from service.requests.captures import InfoRequest
from service.requests.relight import RelightRequest
from tests.marks import first_short
from tests.reference.sampling import lattice
from tests.scenes.captures import edit_manifest, make_scene, render, write_capture, write_exr
from tests.scenes.ellipsoid import ellipsoid

SCENE = make_scene(size=32, lights=12)
AXES = {"x": np.eye(3)[[2, 1, 0]], "y": np.eye(3)[[0, 2, 1]], "-z": -np.eye(3)}
"""What the true directions are multiplied by, by the axis that then looks like the one towards the camera."""


def declared(folder, change, scene=SCENE):
    """Write the capture with other directions, and return what is said of its lights by info, frames and a basis."""
    write_capture(folder, scene)
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    for frame, direction in zip(frames, change(scene.directions), strict=True):
        frame["light"]["direction"] = direction.tolist()
    edit_manifest(folder, frames=frames)
    write_exr(folder.parent / "sky.exr", np.full((16, 32, 3), 0.3, np.float32))
    frame = relight(RelightRequest(capture=folder, environment=str(folder.parent / "sky.exr"), out=str(folder.parent / "frame.#.exr"),
                                   device="cpu"))
    basis = make_basis(BasisRequest(capture=folder, out=folder.parent / "basis.exr", device="cpu"))
    return [[each for each in said if each.startswith("frames")]
            for said in (inspect(InfoRequest(capture=folder)).findings, frame.warnings, basis.warnings)]


@pytest.mark.parametrize("axis", AXES)
def test_axes_along_which_nothing_faces_the_camera_are_named(tmp_path, axis):
    for said in declared(tmp_path / "capture", lambda directions: directions @ AXES[axis]):
        assert len(said) == 1 and f"with {axis} as the axis towards the camera, 100 % face it" in said[0]


@first_short(("signs", "words"), [([1, -1, 1], "the axes look mirrored: with y negated"),
                                  ([-1, -1, 1], "along the outline the normals point inwards"), ([1, 1, 1], None)])
def test_axes_under_which_the_normals_are_of_no_surface_that_stands_free_are_named(tmp_path, signs, words):
    """Lights with y down, or turned by 180°, explain every reading of a matt object as well as the right ones."""
    for said in declared(tmp_path / "capture", lambda directions: directions * signs, ellipsoid(count=12)):
        assert said == [] if words is None else len(said) == 1 and words in said[0]


@pytest.mark.long
def test_lights_of_a_spiral_that_are_one_image_off_are_named(tmp_path):
    """Each is then turned by the golden angle, and all readings fit as well as under the right ones."""
    scene = ellipsoid(count=24)
    spiral, equal = scene.directions[np.argsort(-scene.directions[:, 2])], np.ones((24, 3))
    scene = scene._replace(directions=spiral, irradiance=equal, images=render(scene.normal, scene.albedo, spiral, equal))
    for said in declared(tmp_path / "capture", lambda directions: np.roll(directions, 1, axis=0), scene):
        assert len(said) == 1 and "one image off" in said[0]


@pytest.mark.long
def test_lights_in_another_order_are_named(tmp_path):
    for said in declared(tmp_path / "capture", lambda directions: np.random.default_rng(0).permutation(directions)):
        assert len(said) == 1 and "images and directions do not belong together" in said[0]


def test_light_that_is_on_in_all_images_is_named(tmp_path):
    """Light from above, of half a lamp: other directions than the declared ones explain it as well."""
    scene = SCENE._replace(directions=lattice(24, np.degrees(np.arccos(0.25))), irradiance=np.ones((24, 3)))
    images = render(scene.normal, scene.albedo, scene.directions, scene.irradiance)
    room = 0.5 / np.pi * scene.albedo * (0.5 + 0.5 * scene.normal[..., 1:2])
    for said in declared(tmp_path / "room", lambda directions: directions, scene._replace(images=images + room)):
        assert len(said) == 1 and "share light that is not that of their lamps" in said[0] and "frame of light off" in said[0]
    assert declared(tmp_path / "none" / "capture", lambda directions: directions, scene._replace(images=images)) == [[], [], []]


def test_right_lights_leave_nothing_to_say(tmp_path):
    assert declared(tmp_path / "capture", lambda directions: directions) == [[], [], []]
