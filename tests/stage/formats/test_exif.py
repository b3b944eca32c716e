"""The exposure times that cameras record: used where the manifest asks for it, and named where it heeds none."""

import numpy as np
import pytest

from service.captures.info import inspect
from service.requests.captures import InfoRequest
from stage.capture.capture import Capture
from stage.capture.lighting import distant_lights
from stage.errors import ManifestError
from stage.formats.exif import Exposure
from stage.formats.images import read_header
from stage.stack.brackets import merge_brackets
from stage.stack.ingest import open_stack
from tests.scenes.captures import edit_manifest, make_scene, manifest_of, write_image, write_manifest

SCENE = make_scene(size=12, lights=4)
TIMES = (0.25, 1 / 60)
SETTINGS = {"FNumber": 8.0, "Exif:PhotographicSensitivity": 100}
SCALE = 2.5
"""Recorded value of radiance 1 in a second: at 1/4 s the brightest readings clip, at 1/60 s none."""


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
