"""Which gradient frames of a capture measure what, and what is missing."""

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.capture.gradients import gradient_frames, has_gradients
from stage.capture.lighting import distant_lights
from stage.errors import ManifestError
from tests.scenes.captures import edit_frame, make_scene, write_capture, write_exr, write_manifest

FULL = {"type": "full"}


def gradient(axis: str, sign: int = 1, polarization: str = "none") -> dict:
    return {"type": "gradient", "axis": axis, "sign": sign, "polarization": polarization}


def capture_of(folder, *lights, size: int = 2) -> Capture:
    for index in range(len(lights)):
        write_exr(folder / f"{index}.exr", np.full((size, size, 3), 0.5))
    write_manifest(folder, {"schema": "relit.capture/1", "name": "g",
                            "camera": {"projection": "orthographic", "resolution": [size, size]},
                            "frames": [{"image": f"{i}.exr", "light": light} for i, light in enumerate(lights)]})
    return Capture.open(folder)


def test_rows_are_mean_and_dipole_in_the_order_of_the_stack(tmp_path):
    capture = capture_of(tmp_path, gradient("x"), {"type": "off"}, FULL, gradient("y", -1), gradient("z"))
    frames = gradient_frames(capture)
    assert [frame.image for frame in capture.sources()] == ["0.exr", "2.exr", "3.exr", "4.exr"]
    assert np.array_equal(frames.diffuse, [[0.5, 0.5, 0, 0], [1, 0, 0, 0], [0.5, 0, -0.5, 0], [0.5, 0, 0, 0.5]])
    assert frames.parallel is None and not frames.polarised and frames.unused == ()


@pytest.mark.parametrize("last", [FULL, gradient("full"), gradient("x", -1), gradient("z", -1)])
def test_three_axes_and_a_full_frame_or_one_opposite_are_enough(tmp_path, last):
    assert np.linalg.matrix_rank(gradient_frames(capture_of(tmp_path, *map(gradient, "xyz"), last)).diffuse) == 4


def test_polarised_frames_come_first_and_the_others_are_named(tmp_path):
    axes = [gradient(axis, sign, kind) for kind in ("cross", "parallel") for axis in "xyz" for sign in (1, -1)]
    frames = gradient_frames(capture_of(tmp_path, *axes, FULL, gradient("x")))
    assert frames.polarised and frames.unused == ("12.exr", "13.exr")
    assert not frames.diffuse[6:].any() and frames.diffuse[:6].any(axis=1).all()
    assert frames.parallel is not None and np.array_equal(frames.parallel[6:12], frames.diffuse[:6])


def test_cross_frames_alone_are_diffuse(tmp_path):
    frames = gradient_frames(capture_of(tmp_path, *(gradient(axis, polarization="cross") for axis in ("x", "y", "z", "full"))))
    assert frames.polarised and frames.parallel is None


@pytest.mark.parametrize(("lights", "words"), [
    ([gradient("x"), gradient("z"), FULL], "gradient capture lacks axis y: a normal needs x, y and z"),
    ([gradient("full")], "gradient capture lacks axis x and y and z"),
    ([*map(gradient, "xyz")], "gradient capture lacks a full frame, or the opposite sign of"),
    ([*(gradient(a, polarization="cross") for a in "xyz"), FULL], "lacks a full frame with polarization cross"),
    ([*(gradient(a, s, "cross") for a in "xyz" for s in (1, -1)), gradient("x", 1, "parallel")],
     "lacks axis y and z with polarization parallel"),
    ([*(gradient(a, s, "parallel") for a in "xyz" for s in (1, -1))], "has parallel frames without cross ones"),
    ([FULL, {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}], "none is lit by a gradient light"),
])
def test_what_is_missing_is_named(tmp_path, lights, words):
    with pytest.raises(ManifestError, match=words):
        gradient_frames(capture_of(tmp_path, *lights))


def test_one_pixel_is_no_surface(tmp_path):
    with pytest.raises(ManifestError, match="is 1x1"):
        gradient_frames(capture_of(tmp_path, *map(gradient, "xyz"), FULL, size=1))


def test_full_frames_are_tracking_frames_beside_other_lights(tmp_path):
    write_capture(tmp_path, make_scene(size=6, lights=4))
    edit_frame(tmp_path, 2, light=FULL)
    capture = Capture.open(tmp_path)
    assert not has_gradients(capture) and len(capture.sources()) == 3
    edit_frame(tmp_path, 1, light=gradient("x"))
    assert len(Capture.open(tmp_path).sources()) == 4
    with pytest.raises(ManifestError, match=r"frames\[1\].light: is gradient: this needs distant lights"):
        distant_lights(Capture.open(tmp_path))
