"""Captures that go on where they stopped, and what follows one."""

import json
import shlex
import threading
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.cameras.watched_folder import WatchedFolder
from service.acquisition.checks.expectation import FaultKind
from service.acquisition.early_ingest import PREVIEW_FILE, write_preview
from service.errors import RequestError
from service.relight.sheet import MARGIN, TITLE
from stage.capture.capture import Capture
from stage.errors import StageError
from stage.formats import images
from stage.results.maps import SurfaceMaps
from stage.stack.early import EarlyStack
from stage.stack.ingest import Ingest
from tests.marks import first_short
from tests.scenes.captures import angles_degrees, edit_manifest, make_scene, render, write_capture, write_image
from tests.scenes.patched_rigs import write_plan
from tests.service.acquisition.test_acquire import LAMPS, Stage, by_hand, check, controller, request
from tests.service.full_disk import files_of_at_most

EIGHT_BITS_DEGREES = 0.6
"""A normal of three components in steps of 2/255 is off by up to a half of √3 of them, 0.4°; half readings add 0.05°."""


class Program:
    """A camera that another program releases, with what it tells and what was changed at it or before it."""

    def __init__(self, stage: Stage, folder: Path, rig: Path) -> None:
        self.stage, self.release_stage = stage, stage.release
        self.capture, self._request = folder / "capture", partial(request, folder, stage, rig)
        self.settings: dict[str, str] = {}
        self.gain, self.shift_px, self.ends_after = 1.0, 0, 3
        self.exif: dict[str, float] = {}
        self.stop = threading.Event()
        stage.release = self.release

    def release(self) -> None:
        scene = self.stage.scene
        self.stage.scene = scene._replace(images=np.roll(self.gain * scene.images, self.shift_px, axis=2))
        self.release_stage()
        self.stage.scene = scene
        if self.exif:  # in a file that records the exposure
            path = max(self.stage.folder.iterdir())
            pixels = images.read_pixels(path)
            path.unlink()
            write_image(path.with_suffix(".tif"), np.round(65535 * np.clip(pixels, 0, 1)).astype(np.uint16), **self.exif)
        if self.stage.released == self.ends_after:
            self.stop.set()

    def begin(self, **changes) -> None:
        """Take the first pictures of a capture."""
        assert 0 < acquire(self._request(**changes), refuse_to_ask, stop=self.stop).there <= 3

    def go_on(self) -> int:
        """Take the others, and return how many there are then."""
        return acquire(self._request(), refuse_to_ask).there

    def refused(self, words: str) -> None:
        """Go on, and expect one sentence; the pictures stay, and the lamps are dark."""
        before = (self.capture / "capture.json").read_bytes()
        with pytest.raises(RequestError, match=words) as error:
            self.go_on()
        assert "\n" not in str(error.value)
        assert (self.capture / "capture.json").read_bytes() == before and self.stage.on == set()


@pytest.fixture
def program(tmp_path, monkeypatch):
    """The program that releases the camera, which is stopped after three pictures."""
    stage = Stage(tmp_path / "watch")
    with controller(tmp_path, stage) as (rig, _):
        found = Program(stage, tmp_path, rig)
        monkeypatch.setattr(WatchedFolder, "_release", lambda camera, exposure: stage.release())
        monkeypatch.setattr(WatchedFolder, "settings", property(lambda camera: found.settings))
        yield found


def test_other_settings_are_named_with_both_values_and_the_same_go_on(program):
    program.settings = {"iso": "100", "f-number": "f/8"}
    program.begin()
    released = program.stage.released
    program.settings = {"iso": "100", "f-number": "f/11"}
    program.refused("was begun with f-number f/8, and the camera has f/11 now: set it back, or give another folder")
    assert program.stage.released == released  # before anything is switched
    program.settings = {"iso": "100", "f-number": "f/8"}
    assert program.go_on() == LAMPS + 1
    check(program.capture, program.stage)


def test_a_shutter_speed_that_the_plan_sets_is_no_difference(tmp_path, program, monkeypatch):
    take = WatchedFolder.take
    monkeypatch.setattr(WatchedFolder, "take", lambda camera, exposure: take(camera, None))
    write_plan(tmp_path, {"take": "olat", "exposures_s": [0.1]})
    program.settings = {"shutterspeed": "1/60", "iso": "100"}
    program.begin()
    program.settings = {"shutterspeed": "1/10", "iso": "200"}
    program.refused("was begun with iso 100, and the camera has 200 now")
    program.settings = {"shutterspeed": "1/10", "iso": "100"}
    assert program.go_on() == LAMPS


def test_exif_tells_where_the_camera_does_not(program):
    program.exif = {"ExposureTime": 0.01, "FNumber": 8.0}
    program.begin(color_space="lin_rec709_scene")
    assert json.loads((program.capture / "report.json").read_text())["camera_settings"] == {"ExposureTime": "0.01 s", "FNumber": "8"}
    program.exif = {"ExposureTime": 0.02, "FNumber": 8.0}
    program.refused("was begun with ExposureTime 0.01 s, and the camera has 0.02 s now")


@pytest.mark.parametrize(("gain", "words"), [(1.26, "light_00[1-6], taken again, is brighter by 26 %"), (0.8, "darker by 20 %")])
def test_other_light_is_named(program, gain, words):
    """Neither the camera nor its files tell of a third of a stop; noise of 1e-3 alone is far below a percent of a mean."""
    program.begin()
    program.gain = gain
    program.refused(words)
    program.gain = 1.02
    assert program.go_on() == LAMPS + 1


def test_journals_without_settings_go_on(program):
    """Builds before this one recorded none."""
    program.settings = {"iso": "100"}
    program.begin()
    journal = program.capture / "acquisition.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join(line for line in lines if '"event": "camera"' not in line))
    assert journal.read_text().count("\n") == len(lines) - 1
    program.settings = {"iso": "200"}
    assert program.go_on() == LAMPS + 1


def test_an_object_that_moved_by_three_pixels_is_told(program):
    scene, random = make_scene(size=96, lights=LAMPS), np.random.default_rng(5)
    texture = ndimage.gaussian_filter(random.uniform(size=(96, 96, 1)), (1, 1, 0))
    program.stage.scene = scene._replace(images=scene.images * texture)
    program.begin()
    program.shift_px = 3
    program.refused("everything is shifted by 3, -?0 pixels since 000._light_00. was taken: put it back")
    program.shift_px = 0
    assert program.go_on() == LAMPS + 1


def test_a_disk_that_is_full_after_three_pictures_keeps_them(program):
    program.ends_after = 0
    write = program.release_stage
    with ExitStack() as full:

        def fills() -> None:
            write()
            if program.stage.released == 4:
                full.enter_context(files_of_at_most(100))
        program.release_stage = fills
        with pytest.raises(StageError, match="capture") as error:
            program.go_on()
    assert "\n" not in str(error.value) and program.stage.on == set()
    assert len(Capture.open(program.capture).manifest.frames) == 3
    program.release_stage = write
    assert program.go_on() == LAMPS + 1
    check(program.capture, program.stage)


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
    made = write_preview(write_capture(tmp_path / "capture", scene), "cpu")
    assert made.warnings == ()
    shown = images.read_pixels(made.path).astype(np.float64)[MARGIN + TITLE:, MARGIN:]
    normals = 2 * shown[:64, :64] - 1
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    degrees = np.degrees(np.arccos(np.clip((normals * scene.normal).sum(axis=-1), -1, 1)))[scene.mask]
    assert degrees.max() < EIGHT_BITS_DEGREES
    assert np.abs(shown[:64, :64][~scene.mask]).max() < 0.1  # the background


@pytest.mark.long
def test_an_exposure_that_changes_on_the_way_is_said_with_the_preview(tmp_path):
    """Half as much light under every other lamp of a ring, as where they are taken first, and the others after them."""
    scene = make_scene(size=64, lights=16)
    images_taken = scene.images * np.where(np.arange(16) % 2, 1, 0.5)[:, None, None, None]
    (warning,) = write_preview(write_capture(tmp_path / "capture", scene._replace(images=images_taken)), "cpu").warnings
    assert warning.startswith("frames[].light.irradiance: it is missing or wrong") and "exposure" in warning


@pytest.mark.long
def test_lights_that_are_wrong_are_said_though_most_of_the_picture_is_black(tmp_path):
    """The noise of a black background, an eighth of which is object, hid whatever the object says."""
    scene, random = make_scene(size=64, lights=16), np.random.default_rng(1)
    for name, other, said in (("right", 1.0, None), ("wrong", 0.5, "frames[].light.irradiance")):
        images_taken = scene.images * np.where(np.arange(16) % 2, 1, other)[:, None, None, None]
        dark = np.pad(images_taken, ((0, 0), (64, 64), (64, 64), (0, 0)))
        noisy = dark + 0.01 * dark.max() * random.standard_normal(dark.shape)
        folder = write_capture(tmp_path / name, scene._replace(images=noisy))
        edit_manifest(folder, mask=None, camera=lambda camera: camera | {"resolution": [192, 192]})
        warnings = write_preview(folder, "cpu").warnings
        assert (warnings == ()) if said is None else warnings[0].startswith(said)


def arguments(folder, stage, rig) -> list:
    return ["capture", write_plan(folder, {"take": "olat"}), "--rig", rig, "--camera", f"watch:{stage.folder}", "--out", folder / "capture",
            "--trigger", "x"]


def test_a_capture_is_solved_and_exported(tmp_path, stage, relit):
    with controller(tmp_path, stage) as (rig, _):
        said = relit.done(*arguments(tmp_path, stage, rig), "--then", "solve,export").out
    folder = tmp_path / "capture"
    for path in (folder / PREVIEW_FILE, folder / "maps" / "maps.exr", folder / "asset.usdz"):
        assert path.exists() and str(path) in said
    normal = SurfaceMaps.read(folder / "maps" / "maps.exr").normal
    assert (normal[stage.scene.mask] * stage.scene.normal[stage.scene.mask]).sum(axis=-1).mean() > np.cos(np.radians(5))  # noise


@first_short(("step", "error"), [("solve", KeyboardInterrupt()), ("export", RequestError("no room"))])
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


@pytest.mark.long
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


@pytest.mark.long
def test_brackets_are_taken_merged_and_solved(tmp_path, monkeypatch, relit):
    """The longer exposure clips what is lit most, which is no fault, and has an eighth of the noise of the shorter one elsewhere."""
    stage, solved = Stage(tmp_path / "watch"), {}
    random, noise = np.random.default_rng(3), {"both": 0.004, "short": 0.004, "clean": 0.0}

    def release(camera, exposure_s):
        stage.released += 1
        light = sum((stage.scene.images[lamp] for lamp in stage.on), np.zeros_like(stage.scene.images[0]))
        exposed = exposure_s * 40 * light / stage.scene.images.max()
        noisy = np.clip(exposed + noise[name] * random.standard_normal(light.shape), 0, 1)
        write_image(stage.folder / f"{stage.released:04d}.tif", np.round(65535 * noisy).astype(np.uint16))
    monkeypatch.setattr(WatchedFolder, "_release", release)
    rig, ask = by_hand(tmp_path, stage)
    for name, exposures in (("both", [0.004, 0.03]), ("short", [0.004]), ("clean", [0.02])):
        write_plan(tmp_path, {"take": "olat", "exposures_s": exposures})
        result = acquire(request(tmp_path, stage, rig, out=tmp_path / name, color_space="lin_rec709_scene",
                                 trigger="shoot {exposure_s}"), ask)
        assert (result.faults, result.retaken, result.there) == ((), (), LAMPS * len(exposures))
        relit("solve", tmp_path / name, "--method", "lambert", "--out", tmp_path / name / "maps")
        solved[name] = SurfaceMaps.read(tmp_path / name / "maps" / "maps.exr")
    inside = stage.scene.mask & np.all([maps.mask for maps in solved.values()], axis=0)
    apart = {name: angles_degrees(maps.normal, solved["clean"].normal)[inside].mean() for name, maps in solved.items()}
    assert inside.sum() > 100 and apart["both"] < 0.5 * apart["short"], apart
