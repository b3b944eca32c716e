"""Lamps that a person holds about where Relit asks for them, a dozen degrees off: where they were is found from the pictures."""

import json
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from service.acquisition.acquire import acquire
from service.acquisition.cameras.watched_folder import WatchedFolder
from service.requests.acquire import AcquireRequest
from stage.results.maps import SurfaceMaps
from tests.reference.balls import render as render_ball
from tests.scenes.captures import angles_degrees, edit_manifest, write_exr, write_image
from tests.scenes.ellipsoid import ellipsoid
from tests.service.acquisition.test_acquire import write_rig
from tests.service.calibrate.test_ball_finder import chrome
from tests.service.solve.lights.test_unknown_lights import shiny

NOISE = 0.001
"""The standard deviation of the noise, as a part of full scale."""
BALL = {"centre": np.array([-60.0, 0.0, 0.0]), "radius": 40.0, "pixel_size": 1.0}
WIDTH, HEIGHT = 220, 120


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
    outcome = relit("solve", capture, "--lights", "unknown", "--method", "robust", "--out", tmp_path / "maps")
    assert outcome.code == 0, outcome.err
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
