"""A capture folder: opened whole, or refused with the file and the field."""

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.capture.lighting import check_solvable, distant_lights
from stage.errors import ImageError, ManifestError, StorageError
from tests.scenes.captures import edit_frame, make_scene, ring, write_capture, write_exr, write_image

SCENE = make_scene(size=6, lights=4)


def refused(folder, error=ManifestError) -> str:
    with pytest.raises(error) as caught:
        Capture.open(folder)
    text = str(caught.value)
    assert text.count(str(folder)) == 1 and "\n" not in text
    return text


def test_a_folder_or_its_manifest(tmp_path):
    write_capture(tmp_path, SCENE)
    by_folder, by_file = Capture.open(tmp_path), Capture.open(tmp_path / "capture.json")
    assert by_folder == by_file
    assert by_folder.name == "cap"
    assert (by_folder.mask() == SCENE.mask).all()


def test_without_a_mask_every_pixel_counts(tmp_path):
    assert Capture.open(write_capture(tmp_path, SCENE, mask=None)).mask().all()


def test_the_frames_by_what_lit_them(tmp_path):
    write_capture(tmp_path, SCENE)
    edit_frame(tmp_path, 1, light={"type": "off"})
    edit_frame(tmp_path, 2, light={"type": "full"})
    capture = Capture.open(tmp_path)
    assert [frame.image for frame in capture.sources()] == ["000.exr", "003.exr"]
    lights = distant_lights(capture)
    assert np.allclose(lights.direction, SCENE.directions[[0, 3]]) and np.allclose(lights.irradiance, SCENE.irradiance[[0, 3]])


def test_no_folder_and_no_manifest(tmp_path):
    assert refused(tmp_path / "none").endswith("none: there is no such folder")
    assert "holds no capture.json: see `relit import`" in refused(tmp_path)
    (tmp_path / "file").write_text("")
    assert "there is no such folder" in refused(tmp_path / "file" / "below")


@pytest.mark.parametrize(("change", "words"), [
    ({"mask": "none.png"}, "capture.json: mask: none.png is not in the folder"),
    ({"dark": "none.exr"}, "capture.json: dark: none.exr is not in the folder"),
    ({"flat": "../flat.exr"}, "capture.json: ../flat.exr leads out of the capture's folder"),
    ({"flat": "/etc/passwd"}, "capture.json: /etc/passwd leads out of the capture's folder"),
])
def test_files_that_are_not_there_or_not_here(tmp_path, change, words):
    write_capture(tmp_path, SCENE, **change)
    assert words in refused(tmp_path)


def test_frames_that_are_not_there(tmp_path):
    write_capture(tmp_path, SCENE)
    (tmp_path / "002.exr").unlink()
    assert refused(tmp_path) == f"{tmp_path / 'capture.json'}: frames[2].image: 002.exr is not in the folder"


def test_every_header_is_checked_before_a_pixel(tmp_path):
    write_capture(tmp_path, SCENE)
    write_exr(tmp_path / "003.exr", np.zeros((6, 5, 3)))
    assert refused(tmp_path, ImageError) == f"{tmp_path / '003.exr'}: is 5x6, camera.resolution says 6x6"
    write_exr(tmp_path / "003.exr", np.zeros((6, 6, 3)))
    write_image(tmp_path / "mask.png", np.zeros((7, 6), np.uint8))
    assert "mask.png: is 6x7" in refused(tmp_path, ImageError)


def test_a_folder_in_place_of_an_image(tmp_path):
    write_capture(tmp_path, SCENE)
    (tmp_path / "000.exr").unlink()
    (tmp_path / "000.exr").mkdir()
    assert refused(tmp_path, StorageError).endswith("000.exr: is a directory")


def test_an_environment_reference_has_a_size_of_its_own(tmp_path):
    write_capture(tmp_path, SCENE)
    edit_frame(tmp_path, 3, light={"type": "environment", "image": "probe.exr"})
    assert "frames[3].light.image: probe.exr is not in the folder" in refused(tmp_path)
    write_exr(tmp_path / "probe.exr", np.ones((4, 8, 3)))
    assert len(Capture.open(tmp_path).sources()) == 3


def test_arrays_are_for_time_of_flight_alone(tmp_path):
    write_capture(tmp_path, SCENE)
    np.save(tmp_path / "a.npy", np.zeros((6, 6, 9)))
    edit_frame(tmp_path, 3, image="a.npy")
    assert "a.npy: has an unknown suffix" in refused(tmp_path, ImageError)
    edit_frame(tmp_path, 3, light=None, tof={"type": "pulsed", "bin_s": 1e-10, "start_s": 0})
    assert len(Capture.open(tmp_path).sources()) == 3


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_lights_cannot_be_solved(tmp_path, count):
    capture = Capture.open(write_capture(tmp_path, make_scene(size=6, lights=count)))
    with pytest.raises(ManifestError, match=f"{count} lit by a distant light: a normal needs three or more"):
        check_solvable(capture)


def test_coplanar_lights_cannot_be_solved(tmp_path):
    write_capture(tmp_path, SCENE)
    for index, x in enumerate((-0.5, -0.2, 0.3, 0.6)):
        edit_frame(tmp_path, index, light={"type": "distant", "direction": [x, 0.0, 1.0], "irradiance": [1, 1, 1]})
    with pytest.raises(ManifestError, match="all 4 lights lie in one plane through the object"):
        check_solvable(Capture.open(tmp_path))
    edit_frame(tmp_path, 3, light={"type": "distant", "direction": [0.6, 0.01, 1.0], "irradiance": [1, 1, 1]})
    assert len(check_solvable(Capture.open(tmp_path)).direction) == 4


def test_one_pixel_cannot_be_solved(tmp_path):
    with pytest.raises(ManifestError, match="is 1x1: a surface needs two pixels or more"):
        check_solvable(Capture.open(write_capture(tmp_path, make_scene(size=1, lights=4))))


def test_a_channel_without_light_cannot_be_solved(tmp_path):
    write_capture(tmp_path, SCENE)
    for index, direction in enumerate(ring(4).tolist()):
        edit_frame(tmp_path, index, light={"type": "distant", "direction": direction, "irradiance": [1, 0, 1]})
    with pytest.raises(ManifestError, match="channel G is 0 for every light"):
        check_solvable(Capture.open(tmp_path))


def test_other_lights_cannot_be_taken_for_distant_ones(tmp_path):
    write_capture(tmp_path, SCENE)
    edit_frame(tmp_path, 2, light={"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1]})
    with pytest.raises(ManifestError, match=r"frames\[2\]\.light: is point: this needs distant lights"):
        distant_lights(Capture.open(tmp_path))
    for index in range(4):
        edit_frame(tmp_path, index, light={"type": "off"})
    with pytest.raises(ManifestError, match="none is lit by a distant light"):
        distant_lights(Capture.open(tmp_path))
