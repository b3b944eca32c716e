"""A capture goes on with the camera, the settings, the place and the light with which it was begun, or says what has changed."""

import json
import threading
from contextlib import ExitStack

import numpy as np
import pytest
from scipy import ndimage

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.cameras.camera import open_camera
from service.acquisition.cameras.watched_folder import WatchedFolder
from service.errors import RequestError
from stage.capture.capture import Capture
from stage.errors import StageError
from stage.formats import images
from tests.scenes.captures import make_scene, write_image
from tests.service.acquisition.test_acquire import LAMPS, Stage, check, controller, request
from tests.service.full_disk import files_of_at_most


class Program:
    """A camera that another program releases, with what it tells and what was changed at it or before it."""

    def __init__(self, stage: Stage) -> None:
        self.stage, self.release_stage = stage, stage.release
        self.settings: dict[str, str] = {}
        self.gain, self.shift_px, self.ends_after = 1.0, 0, 0
        self.exif: dict[str, float] = {}
        self.stop = threading.Event()
        stage.release = self.release

    def open(self, given, setup):
        camera = open_camera(given, setup)
        camera.settings = self.settings
        return camera

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


@pytest.fixture
def program(tmp_path, monkeypatch):
    """The program that releases the camera, which is stopped after three pictures."""
    stage = Stage(tmp_path / "watch")
    found = Program(stage)
    found.ends_after = 3
    monkeypatch.setattr(WatchedFolder, "_release", lambda camera, exposure: stage.release())
    monkeypatch.setattr("service.acquisition.acquire.open_camera", found.open)
    return found


def begin(folder, program, rig, **changes) -> None:
    """Take the first pictures of a capture."""
    result = acquire(request(folder, program.stage, rig, **changes), refuse_to_ask, stop=program.stop)
    assert 0 < result.there <= 3


def refused(folder, program, rig, words: str) -> None:
    """Go on, and expect one sentence; the pictures stay, and the lamps are dark."""
    before = (folder / "capture" / "capture.json").read_bytes()
    with pytest.raises(RequestError, match=words) as error:
        acquire(request(folder, program.stage, rig), refuse_to_ask)
    assert "\n" not in str(error.value)
    assert (folder / "capture" / "capture.json").read_bytes() == before and program.stage.on == set()


def test_other_settings_are_named_with_both_values_and_the_same_go_on(tmp_path, program):
    program.settings = {"iso": "100", "f-number": "f/8"}
    with controller(tmp_path, program.stage) as (rig, _):
        begin(tmp_path, program, rig)
        released = program.stage.released
        program.settings = {"iso": "100", "f-number": "f/11"}
        refused(tmp_path, program, rig, "was begun with f-number f/8, and the camera has f/11 now: set it back, or give another folder")
        assert program.stage.released == released  # before anything is switched
        program.settings = {"iso": "100", "f-number": "f/8"}
        assert acquire(request(tmp_path, program.stage, rig), refuse_to_ask).there == LAMPS + 1
        check(tmp_path / "capture", program.stage)


def test_a_shutter_speed_that_the_plan_sets_is_no_difference(tmp_path, program, monkeypatch):
    take = WatchedFolder.take
    monkeypatch.setattr(WatchedFolder, "take", lambda camera, exposure: take(camera, None))
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps({"schema": "relit.plan/1", "settle_s": 0, "sequences": [{"take": "olat", "exposures_s": [0.1]}]}))
    program.settings = {"shutterspeed": "1/60", "iso": "100"}
    with controller(tmp_path, program.stage) as (rig, _):
        begin(tmp_path, program, rig)
        program.settings = {"shutterspeed": "1/10", "iso": "200"}
        refused(tmp_path, program, rig, "was begun with iso 100, and the camera has 200 now")
        program.settings = {"shutterspeed": "1/10", "iso": "100"}
        assert acquire(request(tmp_path, program.stage, rig), refuse_to_ask).there == LAMPS


def test_exif_tells_where_the_camera_does_not(tmp_path, program):
    program.exif = {"ExposureTime": 0.01, "FNumber": 8.0}
    with controller(tmp_path, program.stage) as (rig, _):
        begin(tmp_path, program, rig, color_space="lin_rec709_scene")
        report = json.loads((tmp_path / "capture" / "report.json").read_text())
        assert report["camera_settings"] == {"ExposureTime": "0.01 s", "FNumber": "8"}
        program.exif = {"ExposureTime": 0.02, "FNumber": 8.0}
        refused(tmp_path, program, rig, "was begun with ExposureTime 0.01 s, and the camera has 0.02 s now")


@pytest.mark.parametrize(("gain", "words"), [(1.26, "light_00[1-6], taken again, is brighter by 26 %"), (0.8, "darker by 20 %")])
def test_other_light_is_named(tmp_path, program, gain, words):
    """Neither the camera nor its files tell of a third of a stop; noise of 1e-3 alone is far below a percent of a mean."""
    with controller(tmp_path, program.stage) as (rig, _):
        begin(tmp_path, program, rig)
        program.gain = gain
        refused(tmp_path, program, rig, words)
        program.gain = 1.02
        assert acquire(request(tmp_path, program.stage, rig), refuse_to_ask).there == LAMPS + 1


def test_journals_without_settings_go_on(tmp_path, program):
    """Builds before this one recorded none."""
    program.settings = {"iso": "100"}
    with controller(tmp_path, program.stage) as (rig, _):
        begin(tmp_path, program, rig)
        journal = tmp_path / "capture" / "acquisition.jsonl"
        lines = journal.read_text().splitlines(keepends=True)
        journal.write_text("".join(line for line in lines if '"event": "camera"' not in line))
        assert journal.read_text().count("\n") == len(lines) - 1
        program.settings = {"iso": "200"}
        assert acquire(request(tmp_path, program.stage, rig), refuse_to_ask).there == LAMPS + 1


def test_an_object_that_moved_by_three_pixels_is_told(tmp_path, program):
    scene, random = make_scene(size=96, lights=LAMPS), np.random.default_rng(5)
    texture = ndimage.gaussian_filter(random.uniform(size=(96, 96, 1)), (1, 1, 0))
    program.stage.scene = scene._replace(images=scene.images * texture)
    with controller(tmp_path, program.stage) as (rig, _):
        begin(tmp_path, program, rig)
        program.shift_px = 3
        refused(tmp_path, program, rig, "everything is shifted by 3, -?0 pixels since 000._light_00. was taken: put it back")
        program.shift_px = 0
        assert acquire(request(tmp_path, program.stage, rig), refuse_to_ask).there == LAMPS + 1


def test_a_disk_that_is_full_after_three_pictures_keeps_them(tmp_path, program):
    program.ends_after = 0
    write = program.release_stage
    with controller(tmp_path, program.stage) as (rig, _):
        with ExitStack() as full:

            def fills() -> None:
                write()
                if program.stage.released == 4:
                    full.enter_context(files_of_at_most(100))
            program.release_stage = fills
            with pytest.raises(StageError, match="capture") as error:
                acquire(request(tmp_path, program.stage, rig), refuse_to_ask)
        assert "\n" not in str(error.value) and program.stage.on == set()
        assert len(Capture.open(tmp_path / "capture").manifest.frames) == 3
        program.release_stage = write
        assert acquire(request(tmp_path, program.stage, rig), refuse_to_ask).there == LAMPS + 1
        check(tmp_path / "capture", program.stage)
