"""The response of a projector measured on the set: what its page shows is linear light afterwards."""

import http.client
import json
import threading
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.checks.expectation import FaultKind
from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from stage.capture.capture import Capture
from stage.formats import images
from stage.patterns.codes import draw
from tests.scenes.captures import write_exr
from tests.scenes.patched_rigs import write_plan

SIZE, AMBIENT = (64, 48), 0.03
ALBEDO = np.random.default_rng(1).uniform(0.3, 0.8, (SIZE[1], SIZE[0], 1))
GAMMA = 2.4


def light_of(shown: np.ndarray) -> np.ndarray:
    """Return the light of a projector whose response is no power: dark levels give more, bright ones less."""
    level = shown / 255
    return (level**GAMMA + 0.1 * level) / (1.1 + 0.15 * level**8) * 1.25 / 1.1


class ProjectedScene:
    """A page that shows what the projector asks for, and a camera that sees it pixel by pixel."""

    def __init__(self, folder) -> None:
        self.folder, self.shown, self.taken, self.opened, self.shift = folder, np.zeros(SIZE[::-1]), 0, 0, 0
        self.random = np.random.default_rng(2)

    def tell(self, what: str) -> None:
        self.opened += 1
        address = next(word for word in what.split() if word.startswith("http"))
        threading.Thread(target=self._page, args=[urlsplit(address).netloc], daemon=True).start()

    def _page(self, place: str) -> None:
        after = 0
        try:
            while True:
                number = json.loads(self._get(place, "GET", f"/next?after={after}&width={SIZE[0]}&height={SIZE[1]}"))["number"]
                if number is not None:
                    encoded = self._get(place, "GET", "/pattern.png")
                    self.shown, after = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED), number
                    self._get(place, "POST", f"/shown?number={number}")
        except (OSError, http.client.HTTPException, ValueError):
            return  # the capture has ended

    def _get(self, place: str, method: str, path: str) -> bytes:
        connection = http.client.HTTPConnection(place, timeout=20)
        try:
            connection.request(method, path)
            return connection.getresponse().read()
        finally:
            connection.close()

    def release(self) -> None:
        self.taken += 1
        seen = self.shown if self.shown.ndim == 3 else self.shown[..., None]
        pixels = AMBIENT + np.roll(ALBEDO, self.shift, axis=1) * light_of(seen) + self.random.normal(0, 1e-3, (*SIZE[::-1], 1))
        write_exr(self.folder / f"{self.taken:04d}.exr", np.repeat(np.maximum(pixels, 0), 3, axis=2).astype(np.float32))


@pytest.fixture
def scene(tmp_path, monkeypatch):
    (tmp_path / "watched").mkdir()
    found = ProjectedScene(tmp_path / "watched")
    monkeypatch.setattr("service.acquisition.cameras.watched_folder.WatchedFolder._release", lambda camera, exposure: found.release())
    return found


def request(tmp_path, plan: str, **changes) -> AcquireRequest:
    return AcquireRequest(**{"plan": plan, "camera": f"watch:{tmp_path}/watched", "out": tmp_path / "capture", "projector": SIZE,
                             "projector_port": 0, "trigger": "true", **changes})


def farthest_from_linear(folder) -> float:
    """Return how far the light of any pattern is from what its entry says, as a part of full light."""
    capture = Capture.open(folder)
    worst = 0.0
    for frame in capture.manifest.frames:
        seen = (images.read_pixels(folder / frame.image)[..., :1].astype(np.float32) - AMBIENT) / ALBEDO / light_of(np.float64(255))
        worst = max(worst, float(np.abs(np.mean(seen[..., 0] - draw(frame.pattern, SIZE), axis=0)).max()))
    return worst


@pytest.mark.long
def test_patterns_are_linear_light_once_the_response_is_measured(tmp_path, scene):
    """A level of eight bits is 1/255, at a slope of the response up to 2.3: half of it is .0045; the fit between 17 levels adds less."""
    assert acquire(request(tmp_path, "phase", out=tmp_path / "plain"), refuse_to_ask, scene.tell).faults == ()
    result = acquire(request(tmp_path, "projector-response,phase"), refuse_to_ask, scene.tell)
    assert result.faults == () and result.there == result.shots
    report = json.loads((tmp_path / "capture" / "report.json").read_text())["projector_response"]
    assert len(report["values"]) == 256 and 1.5 < report["gamma"] < 2.4
    even = np.linspace(0, 1, 256)
    assert np.abs(report["values"] - light_of(255 * even) / light_of(np.float64(255))).max() < 0.005
    assert not (tmp_path / "capture" / "projector-response" / "capture.json").exists()
    assert farthest_from_linear(tmp_path / "capture") < 0.01
    assert farthest_from_linear(tmp_path / "plain") > 0.1


@pytest.mark.long
def test_a_capture_goes_on_with_the_response_that_it_measured(tmp_path, scene):
    class Enough(Exception):
        """The program ends."""

    def ending() -> None:
        if scene.taken == 20:
            raise Enough
        ProjectedScene.release(scene)
    scene.release = ending
    with pytest.raises(Enough):
        acquire(request(tmp_path, "projector-response,phase"), refuse_to_ask, scene.tell)
    scene.release = lambda: ProjectedScene.release(scene)
    assert acquire(request(tmp_path, "projector-response,phase"), refuse_to_ask, scene.tell).faults == ()
    assert farthest_from_linear(tmp_path / "capture") < 0.01
    with pytest.raises(RequestError, match="begin a new capture"):
        acquire(request(tmp_path, "projector-response,phase", retake=("projector-response/0002_grey",)), refuse_to_ask, scene.tell)


@pytest.mark.long
def test_white_pictures_between_patterns_show_what_moved_and_what_was_taken_is_shown_again(tmp_path, scene, monkeypatch):
    """The decoded capture has the patterns alone."""
    plan = write_plan(tmp_path, {"take": "patterns", "code": "phase"}, tracking_every=5)

    def run(**changes):
        return acquire(request(tmp_path, str(plan), **changes), refuse_to_ask, scene.tell)

    still = run(out=tmp_path / "still")
    frames = Capture.open(tmp_path / "still").manifest.frames
    white = sorted((tmp_path / "still" / "tracking").glob("*.exr"))
    assert (still.faults, still.retaken, still.there) == ((), (), len(frames) + len(white))
    assert [int(path.name[:4]) for path in white] == [*range(1, still.there, 6), still.there] and len(white) == 4
    assert len({frame.pattern for frame in frames}) == len(frames)

    opened = scene.opened
    key = frames[3].image.removesuffix(".exr")
    before = images.read_pixels(tmp_path / "still" / f"{key}.exr")
    assert run(out=tmp_path / "still", retake=(key,)).faults == ()
    assert scene.opened == opened + 1
    assert np.abs(images.read_pixels(tmp_path / "still" / f"{key}.exr") - before).max() < 0.01  # noise of .001; the pattern is .8

    release, first = scene.release, scene.taken

    def moving() -> None:
        scene.shift = 3 * (scene.taken - first >= 10)
        release()
    monkeypatch.setattr(scene, "release", moving)
    moved = run(out=tmp_path / "moved", retakes=0)
    sides = [{(f"tracking/{path.stem}", FaultKind.MOVED) for path in side} for side in (white[:2], white[2:])]
    assert {(fault.shot, fault.kind) for fault in moved.faults} in sides  # of two and two, nothing tells which are out of place


def test_what_contradicts_itself_is_refused(tmp_path, scene):
    for plan, changes, words in (("phase,projector-response", {}, "put it before"), ("projector-response,phase", {"gamma": 2.2}, "--gamma"),
                                 ("projector-response", {"projector": None}, "--projector")):
        with pytest.raises(RequestError, match=words):
            acquire(request(tmp_path, plan, **changes), refuse_to_ask, scene.tell)
