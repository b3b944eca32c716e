"""Patterns through the page in a browser: a camera that sees the window pixel by pixel decodes where each pixel of the projector is."""

import logging
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.acquisition.acquire import acquire, refuse_to_ask
from service.depth.depth import depth
from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from service.requests.depth import DepthRequest
from stage.capture.capture import Capture
from stage.formats import exr, images
from stage.patterns.codes import draw
from tests.scenes.patched_rigs import write_plan
from tests.service.server.pages.conftest import new_context
from tests.service.waiting import PATIENCE_S

pytestmark = pytest.mark.long
RELEASED = "released"
EXPOSURE = 0.8
"""White does not clip."""


def capture_shown(page, request: AcquireRequest, watched: Path, *, clicked: bool = False):
    """Return what a capture returns whose camera sees the page, which fills the screen once it is clicked: a picture for each release."""
    told, addresses = threading.Event(), []

    def tell(what: str) -> None:
        addresses.append(next(word for word in what.split() if word.startswith("http")))
        told.set()

    outcome: list[object] = []

    def run() -> None:
        try:
            outcome.append(acquire(request, refuse_to_ask, tell))
        except RequestError as error:
            outcome.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    assert told.wait(PATIENCE_S)
    page.goto(addresses[0])
    if clicked:
        page.mouse.click(1, 1)
        page.wait_for_function("() => document.fullscreenElement !== null")
    taken = 0
    while thread.is_alive():
        thread.join(0.005)
        if (watched / RELEASED).exists():
            (watched / RELEASED).unlink()
            taken += 1
            seen = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
            cv2.imwrite(str(watched / f".{taken}.png"), (EXPOSURE * seen).round().astype(np.uint8))
            (watched / f".{taken}.png").rename(watched / f"{taken:04d}.png")
    return outcome[0]


@pytest.fixture
def watched(tmp_path) -> Path:
    """Return a folder that is watched, and in which the release of the camera leaves a file."""
    folder = tmp_path / "watched"
    folder.mkdir()
    return folder


def request_of(tmp_path: Path, watched: Path, size: tuple[int, int], *sequences: dict) -> AcquireRequest:
    return AcquireRequest(plan=str(write_plan(tmp_path, *sequences)), camera=f"watch:{watched}", trigger=f"touch {watched / RELEASED}",
                          out=tmp_path / "capture", projector=size, projector_port=0, color_space="lin_rec709_scene", timeout=PATIENCE_S)


def test_gray_code_and_phases_are_shown_acknowledged_and_decoded(browser, tmp_path, watched):
    size = 520, 513  # ten bits each
    plan = {"take": "patterns", "code": "gray", "axis": "both"}, {"take": "patterns", "code": "phase"}
    request = request_of(tmp_path, watched, size, *plan)
    page = new_context(browser, viewport={"width": size[0], "height": size[1]}).new_page()
    result = capture_shown(page, request, watched)
    page.context.close()
    assert (result.there, result.faults) == (42 + 12, ())  # white and black once
    decoded = depth(DepthRequest(capture=request.out, out=tmp_path / "depth"))
    channels, _ = exr.read(decoded.depth_path)
    assert logging.getLogger("uvicorn").propagate  # the page leaves the logging of the program as it is
    u, v, mask = channels["projector.U"], channels["projector.V"], channels["mask.Y"] > 0
    assert mask.mean() > 0.99
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    assert np.abs(u - columns)[mask].max() <= 0.1  # 8 bits over periods of some 20 pixels
    assert np.abs(v - rows)[mask].max() <= 1e-3  # stripes of one pixel


def test_each_pixel_of_a_pattern_is_one_of_a_screen_of_high_density(browser, tmp_path, watched):
    """Two pixels of the screen for each of the page's, which is full screen; stripes of one pixel are exact."""
    size = 160, 96
    request = request_of(tmp_path, watched, size, {"take": "patterns", "code": "gray", "axis": "both"})
    page = new_context(browser, viewport={"width": size[0] // 2, "height": size[1] // 2}, device_scale_factor=2).new_page()
    result = capture_shown(page, request, watched, clicked=True)
    page.context.close()
    frames = Capture.open(request.out).manifest.frames
    assert (result.there, result.faults) == (len(frames), ())
    for frame in frames:
        seen = images.read_pixels(request.out / frame.image)[..., 0]
        assert np.array_equal(seen > EXPOSURE / 2, draw(frame.pattern, size) > 0.5), frame.pattern


def test_a_window_of_another_size_is_refused(browser, tmp_path, watched):
    request = request_of(tmp_path, watched, (640, 480), {"take": "patterns", "code": "ramp"})
    page = new_context(browser, viewport={"width": 600, "height": 400}).new_page()
    for timeout in (2.0, PATIENCE_S):  # in the first, a slow machine may not open the window
        refused = capture_shown(page, request.model_copy(update={"timeout": timeout}), watched)
        assert isinstance(refused, RequestError)
        if "no window has opened" not in str(refused):
            break
    page.context.close()
    assert "600x400" in str(refused)
