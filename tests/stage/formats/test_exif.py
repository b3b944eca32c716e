"""Exposure and orientation that cameras record in image files."""

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from service.captures.info import inspect
from service.requests.captures import InfoRequest
from stage.capture.capture import Capture
from stage.capture.lighting import distant_lights
from stage.errors import ImageError, ManifestError
from stage.formats.exif import TURNS, Exposure
from stage.formats.images import read_header, read_recorded
from stage.stack.brackets import merge_brackets
from stage.stack.ingest import open_stack
from tests.scenes.captures import edit_manifest, make_scene, manifest_of, write_capture, write_image, write_manifest, write_radiance

SCENE = make_scene(size=12, lights=4)
TIMES = (0.25, 1 / 60)
SETTINGS = {"FNumber": 8.0, "Exif:PhotographicSensitivity": 100}
SCALE = 2.5
"""Recorded value of radiance 1 in a second: at 1/4 s the brightest readings clip, at 1/60 s none."""
CODES = np.random.default_rng(1).integers(0, 256, (4, 6, 3)).astype(np.uint8)


def write_bracketed(folder, settings=(SETTINGS, SETTINGS), **changes):
    """Every light at two exposures, in 16 bits, which EXIF alone says."""
    frames = []
    radiance = SCENE.images / SCENE.images.max() * 4
    for light, image in enumerate(radiance):
        for index, (time, others) in enumerate(zip(TIMES, settings, strict=True)):
            name = f"{light}{index}.tif"
            codes = np.round(np.clip(image * SCALE * time, 0, 1) * 65535).astype(np.uint16)
            write_image(folder / name, codes, **({} if others is None else {"ExposureTime": time, **others}))
            frames.append({"image": name, "light": manifest_of(SCENE)["frames"][light]["light"]})
    write_manifest(folder, {"schema": "relit.capture/1", "name": "b", "frames": frames,
                            "camera": {"projection": "orthographic", "resolution": [12, 12]}, **changes})
    return radiance * SCALE


@pytest.mark.parametrize("suffix", ["tif", "jpg", "png"])
def test_settings_are_read_from_the_header(tmp_path, suffix):
    path = write_image(tmp_path / f"a.{suffix}", np.zeros((4, 6, 3), np.uint8), ExposureTime=0.25, FNumber=8.0)
    assert read_header(path).exposure == Exposure(0.25, 8.0)
    assert read_header(write_image(tmp_path / f"b.{suffix}", np.zeros((4, 6, 3), np.uint8))).exposure == Exposure()


def test_brackets_are_merged_by_the_times_of_their_files(tmp_path):
    """To a code of the exposure that is read: at 1/60 s where 1/4 s clips."""
    radiance = write_bracketed(tmp_path, exposure_from="exif")
    capture = Capture.open(tmp_path)
    assert [frame.exposure_s for frame in capture.manifest.frames] == pytest.approx([*TIMES] * 4, rel=1e-6)
    stack = merge_brackets(open_stack(capture), capture.sources(), distant_lights(capture))
    found, usable = stack.pick_radiance(np.arange(144))
    assert usable.all() and (radiance * TIMES[0] > 1).any()
    np.testing.assert_allclose(found[::2], radiance.reshape(4, 144, 3), rtol=2e-3, atol=1 / 65535 / TIMES[1])


def test_times_that_nobody_uses_are_a_finding(tmp_path):
    write_bracketed(tmp_path)
    (finding, *_) = inspect(InfoRequest(capture=tmp_path)).findings
    assert finding.startswith("frames[].exposure_s: is missing") and "for 0.01667 to 0.25 s" in finding
    edit_manifest(tmp_path, exposure_from="exif")
    assert Capture.open(tmp_path).doubts == ()


@pytest.mark.parametrize(("settings", "words"), [
    ((SETTINGS, None), r"01\.tif has no EXIF exposure time: give exposure_s"),
    ((SETTINGS, {**SETTINGS, "FNumber": 11.0}), r"00\.tif has the f-number 8, 01\.tif 11"),
], ids=["no time", "f-number"])
def test_files_that_do_not_say_enough_are_named(tmp_path, settings, words):
    write_bracketed(tmp_path, settings, exposure_from="exif")
    with pytest.raises(ManifestError, match=words):
        Capture.open(tmp_path)


def test_exposures_are_given_once(tmp_path):
    write_bracketed(tmp_path, exposure_from="exif")
    data = [{**frame, "exposure_s": 1.0} for frame in manifest_of(SCENE)["frames"]]
    edit_manifest(tmp_path, frames=data)
    with pytest.raises(ManifestError, match=r"exposure_from: is given beside frames\[0\]\.exposure_s"):
        Capture.open(tmp_path)


@pytest.mark.parametrize("orientation", TURNS)
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_pixels_are_read_as_other_programs_show_them(tmp_path, suffix, orientation):
    path = write_image(tmp_path / f"a.{suffix}", CODES, Orientation=orientation)
    found, header = read_recorded(path), read_header(path)
    expected = oiio.ImageBufAlgo.reorient(oiio.ImageBuf(str(path))).get_pixels(oiio.UINT8)
    np.testing.assert_array_equal(found, expected)
    if suffix == "png":  # OpenCV 5.0 does not read a TIFF that it has to turn
        np.testing.assert_array_equal(found, cv2.imread(str(path))[..., ::-1])
    assert (header.height, header.width, header.orientation) == (*found.shape[:2], orientation)


def test_jpeg_is_turned_too(tmp_path):
    path = write_image(tmp_path / "a.jpg", CODES, Orientation=6)
    np.testing.assert_array_equal(read_recorded(path), cv2.imread(str(path))[..., ::-1])  # by one library
    assert read_header(path)[:2] == (4, 6)


def test_radiance_files_say_how_their_lines_run(tmp_path):
    path = write_image(tmp_path / "a.hdr", (CODES / 255).astype(np.float32))
    upright = read_recorded(path)
    path.write_bytes(path.read_bytes().replace(b"-Y 4 +X 6", b"+Y 4 +X 6"))  # the first line is the lowest
    np.testing.assert_array_equal(read_recorded(path), upright[::-1])


def test_an_orientation_that_is_none_is_ignored(tmp_path):
    path = write_image(tmp_path / "a.png", CODES, Orientation=9)
    np.testing.assert_array_equal(read_recorded(path), CODES)


def write_turned(folder, orientations):
    """A scene of 6x8 pixels whose frames are recorded lying on their side."""
    scene = make_scene(size=8, lights=4)
    frames = manifest_of(scene)["frames"]
    for index, (frame, image, orientation) in enumerate(zip(frames, scene.images, orientations, strict=True)):
        codes = np.round(image[:, :6] / scene.images.max() * 65535).astype(np.uint16)
        write_image(folder / f"{index}.png", np.rot90(codes) if orientation == 6 else codes, Orientation=orientation)
        frame["image"] = f"{index}.png"
    write_manifest(folder, {"schema": "relit.capture/1", "name": "turned", "frames": frames,
                            "camera": {"projection": "orthographic", "resolution": [6, 8]}})
    return scene


def test_a_capture_is_read_upright_and_info_says_so(tmp_path):
    scene = write_turned(tmp_path, [6, 6, 6, 6])
    stack = open_stack(Capture.open(tmp_path))
    radiance, _ = stack.pick_radiance(np.arange(48))
    np.testing.assert_allclose(radiance, scene.images[:, :, :6].reshape(4, 48, 3) / scene.images.max(), rtol=2.0**-10, atol=1e-5)
    found = inspect(InfoRequest(capture=tmp_path))
    assert dict(found.facts)["orientation"].startswith("turned by 90° clockwise, as EXIF orientation 6 of ")


def test_frames_that_disagree_are_named(tmp_path):
    write_turned(tmp_path, [6, 6, 1, 6])
    with pytest.raises(ManifestError, match=r"to be turned by 90° clockwise \(EXIF orientation 6\), 2\.png"):
        Capture.open(tmp_path)


def test_a_resolution_of_the_recorded_pixels_is_explained(tmp_path):
    write_turned(tmp_path, [6, 6, 6, 6])
    edit_manifest(tmp_path, camera={"projection": "orthographic", "resolution": [8, 6]})
    with pytest.raises(ImageError, match=r"is 6x8 once it is turned by 90° clockwise \(EXIF"):
        Capture.open(tmp_path)


@pytest.mark.parametrize(("lines", "factor"), [
    ((), 1), (("EXPOSURE=4",), 4), (("SOFTWARE=a", "EXPOSURE= 1.00", "pfilt -1", "EXPOSURE=5.000000e-01", "EXPOSURE=8"), 4),
    (("EXPOSURE=no number",), 1), (("EXPOSURE=0",), 1)])
def test_every_exposure_of_a_radiance_header_is_a_factor(tmp_path, lines, factor):
    path = write_radiance(tmp_path / "a.hdr", np.full((4, 6, 3), 0.5), *lines)
    assert read_header(path).multiplied == factor
    np.testing.assert_array_equal(read_recorded(path), 0.5)  # as recorded


@pytest.mark.parametrize(("factors", "exposed", "said"), [((1, 2, 0.25, 1), False, True), ((1, 2, 0.25, 1), True, False),
                                                         ((4, 4, 4, 4), False, False)])
def test_radiance_images_that_were_multiplied_otherwise_are_said(tmp_path, factors, exposed, said):
    write_capture(tmp_path, SCENE)
    frames = manifest_of(SCENE)["frames"]
    for index, (image, factor, frame) in enumerate(zip(SCENE.images, factors, frames, strict=True)):
        frame["image"] = write_radiance(tmp_path / f"{index}.hdr", factor * image, f"EXPOSURE={factor}").name
        frame |= {"exposure_s": factor} if exposed else {}
    edit_manifest(tmp_path, frames=frames)
    words = "frames[].exposure_s: is missing, and EXPOSURE in the headers says that values were multiplied by 0.25 (2.hdr) to 2 (1.hdr)"
    capture = Capture.open(tmp_path)
    assert [doubt.startswith(words) for doubt in capture.doubts] == [True] * said
    if exposed:  # readings are divided by the factors: to a code of RGBE
        found, _ = merge_brackets(open_stack(capture), capture.sources(), distant_lights(capture)).pick_radiance(np.arange(144))
        np.testing.assert_allclose(found, SCENE.images.reshape(4, 144, 3), atol=SCENE.images.max() / 128)
