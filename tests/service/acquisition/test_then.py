"""What follows the last picture of a capture: the preview, and the steps of --then, through the program."""

import json
import shlex

import numpy as np
import pytest

from service.acquisition.checks.expectation import FaultKind
from service.acquisition.preview import PREVIEW_FILE, write_preview
from service.errors import RequestError
from service.relight.sheet import MARGIN, TITLE
from stage.capture.capture import Capture
from stage.formats import images
from stage.results.maps import SurfaceMaps
from stage.stack.early import EarlyStack
from stage.stack.ingest import Ingest
from tests.scenes.captures import make_scene, render, write_capture
from tests.service.acquisition.test_acquire import Stage, controller

EIGHT_BITS_DEGREES = 0.6
"""A normal of three components in steps of 2/255 is off by up to a half of √3 of them, 0.4°; half readings add 0.05°."""


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """A stage whose camera is released by the program of --trigger."""
    found = Stage(tmp_path / "watch")
    scene = found.scene  # under lamps as bright as one another, as the rig says they are
    found.scene = scene._replace(images=render(scene.normal, scene.albedo, scene.directions, np.full(scene.irradiance.shape, 12.0)))
    monkeypatch.setattr("service.acquisition.cameras.watched_folder.WatchedFolder._release", lambda camera, exposure: found.release())
    return found


def test_the_preview_shows_the_normals_of_the_capture(tmp_path):
    scene = make_scene(size=64, lights=8)
    path = write_preview(write_capture(tmp_path / "capture", scene), "cpu")
    shown = images.read_pixels(path).astype(np.float64)[MARGIN + TITLE:, MARGIN:]
    normals = 2 * shown[:64, :64] - 1
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    degrees = np.degrees(np.arccos(np.clip((normals * scene.normal).sum(axis=-1), -1, 1)))[scene.mask]
    assert degrees.max() < EIGHT_BITS_DEGREES
    assert np.abs(shown[:64, :64][~scene.mask]).max() < 0.1  # the background


def arguments(folder, stage, rig) -> list:
    (folder / "plan.json").write_text(json.dumps({"schema": "relit.plan/1", "settle_s": 0, "sequences": [{"take": "olat"}]}))
    words = ["capture", folder / "plan.json", "--rig", rig, "--camera", f"watch:{stage.folder}", "--out", folder / "capture"]
    return [*words, "--trigger", "x"]


def test_a_capture_is_solved_and_exported(tmp_path, stage, relit):
    with controller(tmp_path, stage) as (rig, _):
        said = relit.done(*arguments(tmp_path, stage, rig), "--then", "solve,export").out
    folder = tmp_path / "capture"
    for path in (folder / PREVIEW_FILE, folder / "maps" / "maps.exr", folder / "asset.usdz"):
        assert path.exists() and str(path) in said
    normal = SurfaceMaps.read(folder / "maps" / "maps.exr").normal
    assert (normal[stage.scene.mask] * stage.scene.normal[stage.scene.mask]).sum(axis=-1).mean() > np.cos(np.radians(5))  # noise


@pytest.mark.parametrize(("step", "error"), [("solve", KeyboardInterrupt()), ("export", RequestError("no room"))])
def test_a_step_that_fails_keeps_the_capture_and_says_one_command(tmp_path, stage, relit, monkeypatch, step, error):
    def fails(request, progress):
        raise error
    with monkeypatch.context() as broken, controller(tmp_path, stage) as (rig, _):
        broken.setattr(f"service.{step}.{step}.{step}", fails)
        outcome = relit(*arguments(tmp_path, stage, rig), "--then", "solve,export")
    assert outcome.code == (130 if step == "solve" else 2)
    line = next(line for line in outcome.err.splitlines() if line.startswith("go on"))
    for command in line.partition("whole: ")[2].split(" && "):
        relit.done(*shlex.split(command)[1:])
    assert (tmp_path / "capture" / "asset.usdz").exists()


def test_a_view_that_is_given_later_makes_the_preview_anew(tmp_path, stage, relit):
    path = tmp_path / "capture" / PREVIEW_FILE
    with controller(tmp_path, stage) as (rig, _):
        relit.done(*arguments(tmp_path, stage, rig))
        shown = images.read_pixels(path)
        assert "preview" not in relit.done(*arguments(tmp_path, stage, rig)).out
        assert str(path) in relit.done(*arguments(tmp_path, stage, rig), "--view", "Un-tone-mapped").out
    assert not np.array_equal(images.read_pixels(path), shown)


def test_a_capture_with_a_fault_is_not_solved(tmp_path, stage, relit):
    stage.faults = {4: FaultKind.CLIPPED}
    with controller(tmp_path, stage) as (rig, _):
        outcome = relit(*arguments(tmp_path, stage, rig), "--then", "solve", "--retakes", "0")
    assert outcome.code == 1 and "then     not done" in outcome.out
    assert f"relit solve {tmp_path}/capture --out {tmp_path}/capture/maps" in outcome.out
    assert not (tmp_path / "capture" / "maps").exists()


def test_steps_in_another_order_are_refused(tmp_path, stage, relit):
    assert "give solve, or solve,export" in relit.refused(*arguments(tmp_path, stage, tmp_path / "rig.json"), "--then", "export")


def test_the_stack_is_there_when_the_last_picture_is(tmp_path, stage, relit, monkeypatch):
    """Each picture was decoded while the next was taken: none is left, but one that was taken again in the end."""
    decoded = []
    monkeypatch.setattr(EarlyStack, "add", lambda early, capture, frame, light, add=EarlyStack.add: (
        decoded.append(frame.image), add(early, capture, frame, light)))
    left = []
    monkeypatch.setattr(Ingest, "stack", lambda ingest, progress=None, early=None, stack=Ingest.stack: stack(
        ingest, lambda done, count: left.append((done, count)), early))
    with controller(tmp_path, stage) as (rig, _):
        assert relit(*arguments(tmp_path, stage, rig)).code == 0
    lights = [frame.image for frame in Capture.open(tmp_path / "capture").sources()]
    assert decoded == lights and set(left) == {(len(lights), len(lights))}  # the preview finds it too
    assert not list((tmp_path / "capture" / ".relit").glob(".early*"))
