"""What is looked at before a capture or an environment is worked on: places, headers and sizes, and no pixel."""

import os

import numpy as np
import pytest

from service.captures.admit import admit_capture, admit_environment, environment_file, recheck_capture
from stage.capture.light import PLACEHOLDER
from stage.capture.manifest import read_manifest
from stage.errors import ImageError, ManifestError
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_exr, write_image, write_manifest
from tests.service.recording import Recording

SCENE = make_scene(size=16, lights=4)
PIXELS = 16 * 16
HISTOGRAM = {"schema": "relit.capture/1", "name": "room", "frames": [
    {"image": "00.npy", "tof": {"type": "pulsed", "bin_s": 1e-9, "start_s": 0.0}}],
    "camera": {"projection": "perspective", "resolution": [6, 4], "focal_px": [5, 5]}}


def test_a_capture_is_described_without_its_pixels(tmp_path):
    write_capture(tmp_path, SCENE)
    recording = Recording()
    assert admit_capture(tmp_path, max_pixels=PIXELS, progress=recording) == {
        "captures": 1, "frames": 4, "resolution": [16, 16], "color_space": "lin_rec709_scene", "name": "cap", "lit_by": ["light"],
        "calibrated": ["lights"]}
    assert recording.stages == [("check", 1, [1])]
    recheck_capture(tmp_path, max_pixels=PIXELS)


def test_the_calibrations_of_a_capture_are_told(tmp_path):
    folder = write_capture(tmp_path, SCENE)
    frames = read_manifest(folder / "capture.json").model_dump(mode="json", by_alias=True, exclude_none=True)["frames"]
    matrix = [[1.1, 0, 0], [0, 1, 0], [0, 0, 0.9]]
    edit_manifest(folder, dark=frames[0]["image"], color_matrix=matrix)
    assert admit_capture(tmp_path, max_pixels=PIXELS)["calibrated"] == ["dark", "lights", "colours"]
    placeholder = PLACEHOLDER.model_dump(mode="json", exclude_none=True)
    edit_manifest(folder, frames=[frame | {"light": placeholder} for frame in frames])
    assert admit_capture(tmp_path, max_pixels=PIXELS)["calibrated"] == ["dark", "colours"]


def test_a_sequence_is_counted_and_a_manifest_that_is_wrong_is_named(tmp_path):
    for step in ("t0", "t1", "t2"):
        write_capture(tmp_path / step, SCENE)
    recording = Recording()
    found = admit_capture(tmp_path, max_pixels=PIXELS, progress=recording)
    assert (found["captures"], found["frames"]) == (3, 12) and recording.faults == []
    edit_manifest(tmp_path / "t1", colour="red")
    with pytest.raises(ManifestError, match="colour: is not a known key"):
        admit_capture(tmp_path, max_pixels=PIXELS)


@pytest.mark.parametrize("check", [admit_capture, recheck_capture])
def test_places_and_sizes_are_refused(check, tmp_path):
    folder = write_capture(tmp_path / "cap", SCENE)
    with pytest.raises(ImageError, match="16x16 is more than 255 pixels"):
        check(folder, max_pixels=PIXELS - 1)
    write_exr(tmp_path / "secret.exr", SCENE.images[0])
    (folder / "001.exr").unlink()
    (folder / "001.exr").symlink_to(tmp_path / "secret.exr")
    with pytest.raises(ManifestError, match=r"frames\[1\].image: 001\.exr leads out of the capture's"):
        check(folder, max_pixels=PIXELS)
    (folder / "001.exr").unlink()
    os.mkfifo(folder / "001.exr")  # to open it would wait for ever
    with pytest.raises(ManifestError, match="is no file"):
        check(folder, max_pixels=PIXELS)
    (folder / "001.exr").unlink()
    write_exr(folder / "001.exr", np.zeros((64, 64, 3)))
    with pytest.raises(ImageError, match=r"001\.exr: has 64x64 pixels, 256 are allowed"):
        check(folder, max_pixels=PIXELS)


@pytest.mark.parametrize(("array", "words"), [
    (np.ones((4, 6, 8), np.complex64), "is not an array of real numbers"), (np.ones(6), r"has the shape \(6,\)"),
    (np.ones((40, 6)), "has 6x40 pixels, 24 are allowed"), (np.ones((4, 6, 8), np.float32), "it has 764 bytes of 768"),
])
def test_headers_of_arrays(array, words, tmp_path):
    np.save(tmp_path / "00.npy", array)
    write_manifest(tmp_path, HISTOGRAM)
    if "bytes" in words:  # an array that is cut short
        admit_capture(tmp_path, max_pixels=24)
        (tmp_path / "00.npy").write_bytes((tmp_path / "00.npy").read_bytes()[:-4])
    with pytest.raises(ImageError, match=words):
        admit_capture(tmp_path, max_pixels=24)


def test_an_environment_is_one_lat_long_image(tmp_path):
    folder = tmp_path / "sky"
    folder.mkdir()
    with pytest.raises(ImageError, match="has 0 files"):
        admit_environment(folder, max_pixels=1000)
    path = write_exr(folder / "sky.exr", np.ones((8, 16, 3)))
    (folder / ".notes").write_text("")
    assert admit_environment(folder, max_pixels=128) == {"file": "sky.exr", "resolution": [16, 8]}
    assert environment_file(folder) == environment_file(path) == path
    with pytest.raises(ImageError, match="has 16x8 pixels, 100 are allowed"):
        admit_environment(folder, max_pixels=100)
    write_exr(folder / "b.exr", np.ones((8, 16, 3)))
    with pytest.raises(ImageError, match="has 2 files"):
        admit_environment(folder, max_pixels=1000)
    (folder / "b.exr").unlink()
    write_exr(path, np.ones((8, 8, 3)))
    with pytest.raises(ImageError, match="is 8x8: a lat-long map is twice as wide as it is high"):
        admit_environment(folder, max_pixels=1000)
    path.rename(folder / "sky.png")
    with pytest.raises(ImageError, match=r"\.exr or \.hdr"):
        admit_environment(folder, max_pixels=1000)


def test_the_images_of_other_cameras_count_too(tmp_path):
    pixels = np.zeros((4, 6), np.uint16)
    pose = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    write_image(tmp_path / "left.png", pixels)
    write_image(tmp_path / "right.png", np.zeros((8, 6), np.uint16))
    write_manifest(tmp_path, {
        "schema": "relit.capture/1", "name": "pair", "camera": {"projection": "perspective", "resolution": [6, 4], "focal_px": [9, 9]},
        "other_cameras": [{"name": "right", "resolution": [6, 8], "focal_px": [9, 9], "camera_from_other": pose}],
        "frames": [{"image": "left.png", "stereo": {"images": ["right.png"]}}]})
    admit_capture(tmp_path, max_pixels=48)
    with pytest.raises(ImageError, match=r"other_cameras\[0\].resolution: 6x8 is more than 47 pixels"):
        admit_capture(tmp_path, max_pixels=47)
