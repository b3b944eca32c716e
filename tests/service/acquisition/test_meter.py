"""The light meter against pictures whose radiance is known."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
from scipy import ndimage

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.checks.judge import FULL_SCALE
from service.acquisition.meter import SHARE, TARGET, meter
from service.errors import RequestError
from service.light_estimation.lit_object import OBJECT_PART
from service.requests.acquire import AcquireRequest
from stage.formats import images
from tests.reference.colour import srgb_to_linear
from tests.scenes.captures import make_scene, write_exr
from tests.scenes.patched_rigs import write_plan
from tests.service.acquisition.test_acquire import LAMPS, Stage, controller
from tests.service.acquisition.test_cameras import virtual_camera

LEVEL_STEP = 2 ** (1 / 3)


class MeteredStage(Stage):
    """Lamps on a textured cap, the fifth twice as bright, and a camera whose exposure time is set; noise is a thousandth of full scale."""

    def __init__(self, folder) -> None:
        super().__init__(folder)
        self.scene, self.random, self.exposure, self.blur_px = make_scene(size=96, lights=LAMPS), np.random.default_rng(4), None, 0.0
        texture = 1 + 0.3 * self.random.uniform(-1, 1, self.scene.mask.shape)
        self.radiance = 0.9 * self.scene.images * texture[None, ..., None]
        self.radiance[4] *= 2

    def release(self, exposure: float | None = None) -> None:
        self.released, self.exposure = self.released + 1, exposure
        pixels = (exposure or 1.0) * sum((self.radiance[lamp] for lamp in self.on), np.zeros_like(self.radiance[0]))
        pixels = ndimage.gaussian_filter(pixels, (self.blur_px, self.blur_px, 0))
        write_exr(self.folder / f"IMG_{self.released:04d}.exr", np.clip(pixels + self.random.normal(0, 1e-3, pixels.shape), 0, 1))

    def clipped(self, exposure: float) -> float:
        """Return the share of the object that the brightest lamp clips without noise."""
        brightest = self.radiance.max(axis=(0, 3))
        seen = brightest > OBJECT_PART * brightest.max()
        return max(float((exposure * picture.max(axis=2) >= FULL_SCALE)[seen].mean()) for picture in self.radiance)


@pytest.fixture
def stage(tmp_path, monkeypatch):
    found = MeteredStage(tmp_path / "watch")
    camera = "service.acquisition.cameras.watched_folder.WatchedFolder"
    monkeypatch.setattr(f"{camera}._release", lambda camera, exposure: found.release(exposure))
    return found


def request(folder, stage, rig, exposure: float | None = None) -> AcquireRequest:
    sequence = {"take": "olat"} if exposure is None else {"take": "olat", "exposures_s": [exposure]}
    return AcquireRequest(plan=str(write_plan(folder, sequence)), rig=rig, camera=f"watch:{stage.folder}", out=folder / "meter", timeout=5,
                          trigger="shoot {exposure_s}", preview=True)


@pytest.mark.parametrize("present", [0.01, pytest.param(80.0, marks=pytest.mark.long)])
def test_the_proposed_exposure_clips_less_than_a_thousandth_and_no_third_of_a_stop_is_given_away(tmp_path, stage, present):
    with controller(tmp_path, stage) as (rig, _):
        found = meter(request(tmp_path, stage, rig, present), refuse_to_ask)
    assert stage.on == set() and found.brightest.lamp == "L4" and found.sure
    assert found.clipped < SHARE and stage.clipped(found.exposure_s) < SHARE
    # the target and rounding to thirds of a stop leave room; from 1 % of the light noise of 1e-3 takes 10 % more
    assert stage.clipped(found.exposure_s * LEVEL_STEP / TARGET * 1.25) >= SHARE
    assert stage.exposure == found.exposure_s  # at which the camera is left
    written = json.loads(found.path.read_text())
    assert written["proposed"]["exposure_s"] == found.exposure_s and len(written["readings"]) == LAMPS and sum(written["histogram"]) > 0


@pytest.mark.long
def test_clipped_pixels_have_stripes(tmp_path, stage):
    with controller(tmp_path, stage) as (rig, _):
        red = []
        for present in (0.1, 4.0):
            shown = images.read_pixels(meter(request(tmp_path, stage, rig, present), refuse_to_ask).picture).astype(np.float32)
            red.append(((shown[..., 0] > 0.95) & (shown[..., 1:].max(axis=2) < 0.15)).sum())
    assert red[0] == 0 and red[1] > 1000


@pytest.mark.long
def test_a_camera_that_cannot_be_set_gets_a_factor(tmp_path, stage):
    with controller(tmp_path, stage) as (rig, _):
        found = meter(request(tmp_path, stage, rig), refuse_to_ask)
        assert found.exposure_s is None and found.sure is (stage.clipped(1.0) < SHARE)
        stage.radiance *= 0.2
        dim = meter(request(tmp_path, stage, rig), refuse_to_ask)
        assert dim.sure and stage.clipped(dim.factor) < SHARE <= stage.clipped(dim.factor * LEVEL_STEP / TARGET * 1.1)
        stage.radiance *= 50
        over = meter(request(tmp_path, stage, rig), refuse_to_ask)
        assert not over.sure and over.factor < 1 and over.clipped is None


@pytest.mark.long
def test_the_focus_score_falls_with_blur(tmp_path, stage):
    scores = []
    with controller(tmp_path, stage) as (rig, _):
        for stage.blur_px in (0.0, 0.7, 1.5):
            scores.append(meter(request(tmp_path, stage, rig, 0.3), refuse_to_ask).brightest.focus)
    assert scores[0] > 1.3 * scores[1] > 1.3 ** 2 * scores[2]


def test_what_cannot_be_metered_is_refused(tmp_path, stage, relit):
    with controller(tmp_path, stage) as (rig, _):
        given = request(tmp_path, stage, rig, 0.3)
        with pytest.raises(RequestError, match="no picture of the object under lamps"):
            meter(given.model_copy(update={"plan": "dark"}), refuse_to_ask)
        with pytest.raises(RequestError, match="exposure_s"):
            meter(given.model_copy(update={"trigger": "shoot"}), refuse_to_ask)
        acquire(given, refuse_to_ask)
        with pytest.raises(RequestError, match="another folder"):
            meter(given, refuse_to_ask)
        said = relit.done("capture", given.plan, "--rig", rig, "--camera", given.camera, "--out", tmp_path / "other", "--trigger",
                          given.trigger, "--preview").out
    assert "lamp     L4: 0" in said and "\nexposure " in said and stage.on == set()
    assert not (tmp_path / "other" / "capture.json").exists()


@pytest.mark.long
@pytest.mark.parametrize(("grey", "proposed"), [(100, 0.05), (205, 0.01)])
def test_a_virtual_camera_is_metered_and_left_at_the_longest_time_it_offers(tmp_path, stage, grey, proposed):
    """Its pictures are the same at all times. Grey of 100 reads 13 % of full scale, so that six times the 0.01 s that it has, or less, do;
    205 reads 61 %, and it has no time between 0.01 s and 0.02 s."""
    (tmp_path / "card").mkdir()
    cv2.imwrite(str(tmp_path / "card" / "a.jpg"), np.full((48, 64, 3), grey, np.uint8))
    environment = virtual_camera(tmp_path / "card")
    with controller(tmp_path, stage) as (rig, _):
        request(tmp_path, stage, rig)
        words = ["capture", tmp_path / "plan.json", "--rig", rig, "--camera", "gphoto2", "--out", tmp_path / "meter", "--preview"]
        done = subprocess.run([sys.executable, "-m", "service.cli.main", *map(str, words)], env=environment, capture_output=True, text=True,
                              timeout=60)
    assert done.returncode == 0, done.stderr
    assert f"exposure {proposed:g} s, " in done.stdout and stage.on == set()
    found = json.loads((tmp_path / "meter" / "meter.json").read_text())
    assert found["proposed"]["exposure_s"] == proposed and found["proposed"]["factor"] == pytest.approx(proposed / 0.01)
    assert found["proposed"]["sure"] and found["camera_settings"]["shutterspeed"] == f"{proposed:.4f}s"
    linear = srgb_to_linear(np.full(LAMPS, grey / 255))
    assert [reading["bright"] for reading in found["readings"]] == pytest.approx(linear, rel=0.05)  # JPEG
