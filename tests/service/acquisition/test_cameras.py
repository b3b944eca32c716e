"""Cameras that no test can reach are stood in for by libgphoto2's virtual camera, and by a video file."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.acquisition.cameras.camera import NoPictureError, Setup, open_camera
from service.acquisition.cameras.gphoto2_camera import seconds_of
from service.errors import RequestError

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


@pytest.mark.parametrize("given", ["tin:0", "watch:", "watch:/nowhere", "video:", "video:/nowhere.avi"])
def test_a_camera_that_is_not_there(tmp_path, given):
    with pytest.raises(RequestError, match="--camera"):
        open_camera(given, Setup(tmp_path, 1.0, (), None))
