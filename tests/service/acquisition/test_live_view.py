"""The live view, and captures that a page starts."""

import json
import os
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from service.acquisition.acquire import acquire
from service.acquisition.live_view import LiveView
from service.acquisition.remote_control import RemoteControl
from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from stage.formats import images
from stage.transforms import rotation_about
from tests.scenes.captures import angles_degrees, write_exr
from tests.scenes.chart import CAMERA, Pose, picture, reflectances, shoot
from tests.scenes.video import write_video
from tests.service.acquisition.test_acquire import LAMPS, Stage, controller, write_rig
from tests.service.acquisition.test_cameras import virtual_camera
from tests.service.calibrate.test_ball_finder import DIRECTIONS, chrome, photograph
from tests.service.waiting import until

ROOT = Path(__file__).parents[3]


def video(path: Path, *, blur_px: float, frames: int = 3) -> Path:
    """A video of one frame again and again: fine texture, and a quarter of it at full scale."""
    frame = np.random.default_rng(3).integers(40, 160, (200, 240), dtype=np.uint8)
    frame = cv2.GaussianBlur(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR), (0, 0), blur_px)
    frame[100:, 120:] = 255
    return write_video(path, [frame] * frames)


@pytest.mark.long
def test_it_tells_focus_and_stripes_what_clips_and_the_lamps_are_dark_when_it_ends(tmp_path):
    stage, focus = Stage(tmp_path / "watch"), []
    with controller(tmp_path, stage) as (rig, _):
        for blur_px in (0.5, 3.0):
            view = LiveView(rig, f"video:{video(tmp_path / 'video.avi', blur_px=blur_px)}", tmp_path / "live")
            until(lambda view=view: view.state()["number"] > 4)  # a video of three frames begins again
            focus.append(view.state()["focus"])
            assert stage.on == set(range(LAMPS))
            view.close()
            assert stage.on == set()
    assert view.state()["clipped"] == pytest.approx(1 / 4, abs=0.01)  # JPEG, at the borders
    assert focus[0] > 1.2 * focus[1]  # JPEG adds details of its own to the blurred one
    shown = images.read_pixels(tmp_path / "live" / "live.png").astype(np.float32)
    red = (shown[..., 0] > 0.9) & (shown[..., 1] < 0.2)
    assert red[104:200, 124:].mean() == pytest.approx(1 / 2, abs=0.05) and not red[:96].any()
    bins = (shown[200:] - shown[200, 0]).any(axis=2).sum(axis=0)  # the height of the histogram below it
    assert red[-1, -3:].all() and not red[200:, :-4].any() and bins[:20].max() == 0 < bins[100]  # a quarter clips; nothing is black


@pytest.mark.long
def test_the_meter_shows_the_live_view_on_a_page_before(tmp_path):
    """On a terminal, until Enter; the lamps are dark, and the pictures are metered, after it."""
    stage = Stage(tmp_path / "watch")
    with controller(tmp_path, stage) as (rig, _):
        person, terminal = os.openpty()
        command = [sys.executable, "-m", "service.cli.main", "capture", "olat", "--rig", rig, "--camera",
                   f"video:{video(tmp_path / 'video.avi', blur_px=0.5, frames=30)}", "--out", tmp_path / "out", "--preview"]
        program = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdin=terminal, stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE, text=True)
        page = next(word.rstrip(",") for line in program.stderr if "then press Enter" in line for word in line.split() if "http" in word)
        assert stage.on == set(range(LAMPS))

        def asked(path: str) -> bytes:
            with urllib.request.urlopen(page + path, timeout=20) as answer:
                return answer.read()

        state = until(lambda: (found := json.loads(asked("/state.json")))["clipped"] is not None and found)
        assert state["clipped"] == pytest.approx(1 / 4, abs=0.01) and state["focus"] > 0
        assert asked("/live.png").startswith(b"\x89PNG") and b"live.js" in asked("/") and b"Focus" in asked("/live.js")
        with pytest.raises(urllib.error.HTTPError, match="404"):
            asked("/rig.json")
        os.write(person, b"\n")
        said, _ = program.communicate(timeout=60)
        os.close(person)
        os.close(terminal)
    assert program.returncode == 0 and "exposure" in said and stage.on == set()
    assert json.loads((tmp_path / "out" / "meter.json").read_text())["readings"]


def test_a_camera_without_a_live_view_is_refused(tmp_path):
    with pytest.raises(RequestError, match="no live view"):
        LiveView(tmp_path / "rig.json", f"watch:{tmp_path}", tmp_path / "live")


@pytest.mark.long
def test_the_virtual_camera_has_none_and_the_sentence_says_so(tmp_path):
    stage = Stage(tmp_path / "watch")
    (tmp_path / "card").mkdir()
    cv2.imwrite(str(tmp_path / "card" / "a.jpg"), np.full((24, 32, 3), 200, np.uint8))
    with controller(tmp_path, stage) as (rig, _):
        command = [sys.executable, "-m", "service.acquisition.live_view", rig, "gphoto2", tmp_path / "live"]
        environment = virtual_camera(tmp_path / "card") | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, stage.on) == (1, set())
    assert json.loads(done.stdout.splitlines()[-1])["refused"].startswith("--camera gphoto2: libgphoto2 does not know")


@pytest.mark.long
def test_a_capture_is_calibrated_by_the_ball_and_the_chart_that_belong_to_it(tmp_path, monkeypatch):
    """Under lamps that the rig file has 6 degrees elsewhere; half a degree is what a ball of this size is found to."""
    turned = DIRECTIONS @ rotation_about((0, 1, 0), 6).T
    rig = write_rig(tmp_path / "rig.json", SimpleNamespace(scene=SimpleNamespace(directions=turned)), "manual")
    watched, captures, random = tmp_path / "watched", tmp_path / "set", np.random.default_rng(1)
    surface = random.uniform(0.1, 0.5, (240, 320, 3))
    watched.mkdir()
    monkeypatch.setattr("service.acquisition.cameras.watched_folder.WatchedFolder._release", lambda camera, exposure: write_exr(
        watched / f"{len(list(watched.iterdir())):04d}.exr", random.uniform(0.5, 1) * surface))
    acquire(AcquireRequest(plan="olat", rig=rig, camera=f"watch:{watched}", out=captures / "owl", trigger="true"), lambda what: None)
    stage = RemoteControl(rig, f"watch:{watched}", captures)
    with pytest.raises(RequestError, match="'ball' is not there"):
        stage.calibrate("ball")
    stage.open("owl")
    assert stage.state()["calibrations"] == {}
    photograph(captures / "owl-ball" / "mirror-ball", "orthographic", chrome)
    shoot(captures / "owl-chart" / "chart", [picture(reflectances() @ CAMERA.T, Pose(), size=(320, 240)).pixels])
    before = stage.state()
    assert before["calibrations"] == {"ball": False, "chart": False}

    for step in ("ball", "chart"):
        stage.calibrate(step)
        assert stage.state()["calibrating"] == step
        until(lambda: not stage.state()["running"] and stage.state()["calibrating"] is None, "it has not ended")
        assert stage.state()["code"] == 0 and stage.state()["calibrations"][step], stage.state()["lines"]
    after = stage.state()
    assert after["version"] != before["version"]
    content = json.loads((captures / "owl" / "capture.json").read_text())
    assert angles_degrees(np.array([frame["light"]["direction"] for frame in content["frames"]]), DIRECTIONS).max() < 0.5
    found = np.array(content["color_matrix"]) @ CAMERA  # undoes what the camera sees, up to its exposure
    assert np.abs(found / found[1, 1] - np.eye(3)).max() < 0.02  # of three digits that the camera has
