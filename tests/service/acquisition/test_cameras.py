"""Cameras that take pictures, and lamps that a person holds."""

import json
import os
import subprocess
import sys
import threading
from ctypes.util import find_library
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from service.acquisition.acquire import acquire
from service.acquisition.cameras import aravis_camera
from service.acquisition.cameras.aravis_camera import FORMATS, LIBRARY
from service.acquisition.cameras.camera import NoPictureError, Setup, open_camera
from service.acquisition.cameras.gphoto2_camera import seconds_of
from service.acquisition.cameras.watched_folder import WatchedFolder
from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from stage.importers.layout import color_space_of
from stage.results.maps import SurfaceMaps
from tests.reference.balls import render as render_ball
from tests.scenes.captures import angles_degrees, edit_manifest, write_exr, write_image
from tests.scenes.ellipsoid import ellipsoid
from tests.scenes.video import write_video
from tests.service.acquisition.test_acquire import write_rig
from tests.service.calibrate.test_ball_finder import chrome
from tests.service.solve.lights.test_unknown_lights import shiny

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
NOISE = 0.001
"""The standard deviation of the noise, as a part of full scale."""
BALL = {"centre": np.array([-60.0, 0.0, 0.0]), "radius": 40.0, "pixel_size": 1.0}
WIDTH, HEIGHT = 220, 120


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


def grey_video(path, levels):
    return write_video(path, [np.full((48, 64, 3), level, np.uint8) for level in levels])


def test_a_video_gives_its_frames_in_order_and_ends(tmp_path):
    path = grey_video(tmp_path / "video.avi", (40, 200))
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
    path, opened = grey_video(tmp_path / "video.avi", range(0, 200, 20)), cv2.VideoCapture
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
    monkeypatch.setattr(aravis_camera, "_library", aravis_camera._library.__wrapped__)
    monkeypatch.setattr(aravis_camera, "LIBRARY", "of-no-such-name")
    with pytest.raises(RequestError, match="apt install libaravis"):
        open_camera("aravis:Fake_1", Setup(tmp_path / "spool", 5.0, (), None))


def capture_by_hand(folder: Path, monkeypatch, directions: np.ndarray, pictures: np.ndarray) -> Path:
    """Take a capture whose lamps shine from `directions`, [lamps, 3], and give `pictures`, [lamps, rows, cols, 3]; the rig has them
    elsewhere. It is stopped after five pictures and goes on with the fifth lamp held so that its shadows are three pixels off."""
    random, watched, shining, released, stop = np.random.default_rng(5), folder / "watched", [], [], threading.Event()
    rough = directions + np.radians(10) * random.normal(size=directions.shape)
    rough /= np.linalg.norm(rough, axis=1, keepdims=True)
    assert angles_degrees(rough, directions).mean() > 10
    watched.mkdir()
    rig = write_rig(folder / "rig.json", SimpleNamespace(scene=SimpleNamespace(directions=rough)), "manual")

    def release(camera, exposure) -> None:
        picture = np.roll(pictures[shining[-1]], 3 * (shining[-1] in released), axis=1)
        write_exr(watched / f"{len(released):04d}.exr", np.maximum(picture + NOISE * random.standard_normal(picture.shape), 0))
        released.append(shining[-1])
        if len(released) == 5:
            stop.set()

    def ask(what: str) -> None:
        shining.extend(index for index in range(len(directions)) if f"L{index} " in what)

    monkeypatch.setattr(WatchedFolder, "_release", release)
    request = AcquireRequest(plan="olat", rig=rig, camera=f"watch:{watched}", out=folder / "capture", trigger="true")
    assert acquire(request, ask, stop=stop).there == 5
    result = acquire(request, ask)
    assert (result.faults, result.there, released) == ((), len(directions), [0, 1, 2, 3, 4, *range(4, len(directions))])
    return folder / "capture"


def directions_in(capture: Path) -> np.ndarray:
    return np.array([frame["light"]["direction"] for frame in json.loads((capture / "capture.json").read_text())["frames"]])


@pytest.mark.long
def test_directions_are_found_without_anything_else_in_the_picture(tmp_path, monkeypatch, relit):
    scene = shiny(ellipsoid(count=24), (0.45, 0.6), 0.08)
    capture = capture_by_hand(tmp_path, monkeypatch, scene.directions, 0.8 * scene.images / scene.images.max())
    write_image(capture / "mask.png", (scene.mask * 255).astype(np.uint8))
    edit_manifest(capture, mask="mask.png")
    relit.done("solve", capture, "--lights", "unknown", "--method", "robust", "--out", tmp_path / "maps")
    found = np.array(json.loads((tmp_path / "maps" / "report.json").read_text())["found"]["unknown_lights"]["directions"])
    assert angles_degrees(found, scene.directions).mean() < 4  # what unknown lights reach on this scene without a capture by hand
    maps = SurfaceMaps.read(tmp_path / "maps" / "maps.exr")
    assert angles_degrees(maps.normal, scene.normal)[maps.mask & scene.mask].mean() < 5


@pytest.mark.long
def test_directions_are_measured_by_a_ball_beside_the_object(tmp_path, monkeypatch, relit):
    scene = ellipsoid(size=HEIGHT, count=12)
    pictures = []
    for direction, irradiance, lit in zip(scene.directions, scene.irradiance.mean(axis=1), scene.images, strict=True):
        ball, coverage = render_ball(chrome(direction), width=WIDTH, height=HEIGHT, samples=3, **BALL)
        wall = np.pad(np.where(scene.mask, lit.mean(axis=2), 0.2 * irradiance * direction[2]), ((0, 0), (WIDTH - HEIGHT, 0)), mode="edge")
        pictures.append(0.4 * np.repeat((ball + (1 - coverage) * wall)[..., None], 3, axis=2))
    capture = capture_by_hand(tmp_path, monkeypatch, scene.directions, np.array(pictures))
    assert angles_degrees(directions_in(capture), scene.directions).mean() > 10
    relit.done("calibrate", "mirror-ball", capture)
    assert angles_degrees(directions_in(capture), scene.directions).max() < 1  # the lamp's reflection is 0.6° wide
    relit.done("solve", capture, "--method", "robust", "--crop", f"{WIDTH - HEIGHT},0,{HEIGHT},{HEIGHT}", "--out", tmp_path / "maps")
    maps = SurfaceMaps.read(tmp_path / "maps" / "maps.exr")
    assert angles_degrees(maps.normal, scene.normal)[maps.mask & scene.mask].mean() < 3
