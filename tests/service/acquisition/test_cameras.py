"""Cameras that no test can reach are stood in for by libgphoto2's virtual camera, by that which Aravis feigns, and by a video file."""

import json
import os
import subprocess
import sys
from ctypes.util import find_library
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.acquisition.cameras.aravis_camera import FORMATS, LIBRARY
from service.acquisition.cameras.camera import NoPictureError, Setup, open_camera
from service.acquisition.cameras.gphoto2_camera import seconds_of
from service.errors import RequestError
from stage.importers.layout import color_space_of

TAKEN = """
import json, sys
from pathlib import Path
from service.acquisition.cameras.camera import Setup, open_camera
from service.errors import RequestError

camera = open_camera("gphoto2", Setup(Path(sys.argv[1]), 5.0, (), None))
picture = camera.take(0.02)
after = camera.settings
try:
    camera.take(0.3)
    refused = ""
except RequestError as error:
    refused = str(error)
camera.close()
print(json.dumps({"shape": picture.pixels.shape, "mean": float(picture.pixels.mean()), "name": picture.path.suffix,
                  "settings": after, "refused": refused}))
"""


def virtual_camera(folder: Path) -> dict[str, str]:
    """Return the environment in which libgphoto2 finds one virtual camera, whose pictures are the JPEG files of a folder."""
    gphoto2 = pytest.importorskip("gphoto2")
    ports = Path(gphoto2.__file__).parent / "libgphoto2" / "vusb"
    if not ports.is_dir():
        pytest.skip("this build of libgphoto2 has no virtual camera")
    return {**os.environ, "IOLIBS": str(ports), "VCAMERADIR": str(folder)}


def test_the_virtual_camera_takes_a_picture_at_the_exposure_that_is_asked_for(tmp_path):
    (tmp_path / "card").mkdir()
    cv2.imwrite(str(tmp_path / "card" / "a.jpg"), np.full((24, 32, 3), 200, np.uint8))
    done = subprocess.run([sys.executable, "-c", TAKEN, str(tmp_path / "spool")], env=virtual_camera(tmp_path / "card"),
                          capture_output=True, text=True, timeout=60)
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["shape"] == [24, 32, 3]
    assert found["mean"] == pytest.approx(200 / 255, abs=2 / 255)  # JPEG
    assert found["settings"]["shutterspeed"] == "0.0200s"
    assert found["settings"]["cameramodel"] == "VC"
    assert "exposures_s" in found["refused"]


@pytest.mark.parametrize(("text", "seconds"), [("1/60", 1 / 60), ("0.0100s", 0.01), ("30", 30.0), ('2.5"', 2.5), ("bulb", None),
                                               ("0", None)])
def test_exposure_times_as_cameras_write_them(text, seconds):
    assert seconds_of(text) == (None if seconds is None else pytest.approx(seconds))


def test_a_video_gives_its_frames_in_order_and_ends(tmp_path):
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for level in (40, 200):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    camera = open_camera(f"video:{path}", Setup(tmp_path / "spool", 1.0, (), None))
    means = [255 * float(camera.take(None).pixels.mean()) for _ in range(2)]
    assert means == pytest.approx([40, 200], abs=4)  # JPEG
    with pytest.raises(NoPictureError):
        camera.take(None)
    with pytest.raises(RequestError, match="exposures_s"):
        camera.take(0.1)
    camera.close()


def test_a_video_device_gives_no_frame_that_was_taken_before_the_release(tmp_path, monkeypatch):
    """A device by its number, behind which a file is opened: a device keeps four frames, which the lamps before have lit."""
    path, opened = tmp_path / "video.avi", cv2.VideoCapture
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for level in range(10):
        writer.write(np.full((48, 64, 3), 20 * level, np.uint8))
    writer.release()
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: opened(str(path)))
    camera = open_camera("video:0", Setup(tmp_path / "spool", 1.0, (), None))
    assert [255 * float(camera.take(None).pixels.mean()) for _ in range(2)] == pytest.approx([80, 180], abs=4)  # JPEG
    assert (camera.settings["width"], camera.settings["height"]) == ("64", "48")
    with pytest.raises(NoPictureError):
        camera.take(None)
    camera.close()


@pytest.mark.parametrize("given", ["tin:0", "watch:", "watch:/nowhere", "video:", "video:/nowhere.avi"])
def test_a_camera_that_is_not_there(tmp_path, given):
    with pytest.raises(RequestError, match="--camera"):
        open_camera(given, Setup(tmp_path, 1.0, (), None))


@pytest.mark.parametrize("name", [name for name, (_, mosaic) in FORMATS.items() if mosaic is not None])
def test_mosaics_are_those_that_genicam_names(name):
    """BayerRG begins with a row of red and green, and has blue below green."""
    colour = {"R": 200, "G": 120, "B": 40}
    first = name[5:7]
    second = {"RG": "GB", "BG": "GR", "GR": "BG", "GB": "RG"}[first]
    bits, code = FORMATS[name]
    raw = np.tile(np.array([[colour[c] for c in first], [colour[c] for c in second]], np.uint8 if bits == 8 else np.uint16), (6, 6))
    assert (cv2.cvtColor(raw, code) == [200, 120, 40]).all()


def test_the_camera_that_aravis_feigns_takes_pictures_at_exposures(tmp_path):
    """Its picture is a ramp with all levels that moves; exposure times are those that it tells."""
    if find_library(LIBRARY) is None:
        pytest.skip("the library Aravis is not installed")
    camera = open_camera("aravis:Fake_1", Setup(tmp_path / "spool", 5.0, (), None))
    assert camera.settings["DeviceVendorName"] == "Aravis" and camera.settings["PixelFormat"] == "RGB8"
    first, second = camera.take(0.02), camera.take(None)
    assert first.pixels.shape == (512, 512, 3) and first.path != second.path and camera.exposure_s == pytest.approx(0.02)
    assert color_space_of(first.path) == "lin_rec709_scene"  # a reading is proportional to light, and no code of a screen
    assert first.pixels.min() == 0 and first.pixels.max() > 0.9
    seen = camera.look()
    assert seen.shape == (512, 512, 3) and seen.mean() > first.pixels.mean()
    camera.close()
    with pytest.raises(RequestError, match="aravis:Nobody: no camera is found"):
        open_camera("aravis:Nobody", Setup(tmp_path / "spool", 5.0, (), None))


def test_without_aravis_its_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("service.acquisition.cameras.aravis_camera._library", lambda: None)
    with pytest.raises(RequestError, match="apt install libaravis"):
        open_camera("aravis:Fake_1", Setup(tmp_path / "spool", 5.0, (), None))
