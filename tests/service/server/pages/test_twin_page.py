"""The page of relit twin in a browser: the owl under a warm sun and a blue sky, as its lamps are driven."""

import json
import signal
import threading
from contextlib import ExitStack

import numpy as np
import pytest

from service.play.play import play
from service.requests.play import PlayRequest
from tests.scenes.patched_rigs import loopback, write_cues_file, write_rig_file
from tests.service.server.pages.conftest import SAMPLES, expect, keep, opened_page
from tests.service.twin_program import twin_running


@pytest.mark.long
def test_the_twin_shows_the_sample(browser, tmp_path):
    frames = json.loads((SAMPLES / "owl" / "capture.json").read_text())["frames"]
    directions, host = np.array([frame["light"]["direction"] for frame in frames]), loopback()
    rig = write_rig_file(tmp_path / "rig.json", directions, host=host, universes=2, name="the owl's dome")
    near = [np.clip((directions @ np.array(way) / np.linalg.norm(way) - 0.6) / 0.4, 0, 1) for way in ((-1.0, 0.5, 1.0), (1.0, 0.7, 0.2))]
    levels = np.outer(near[0], [1, 0.7, 0.4]) + np.outer(near[1], [0.05, 0.15, 0.5])
    steps = np.round(255 * np.minimum(levels, 1)).astype(int).reshape(1, -1)
    cues, stop = write_cues_file(tmp_path / "cues.json", rig, steps), threading.Event()
    player = threading.Thread(target=play, args=[PlayRequest(cues=cues, rig=rig, hold=1), stop])
    with twin_running(rig, SAMPLES / "owl", host, "--cache", tmp_path) as (program, address), ExitStack() as ending:
        ending.callback(stop.set)
        page = ending.enter_context(opened_page(browser, viewport={"width": 1000, "height": 640}))
        page.goto(address)
        expect(page.locator("#state")).to_contain_text("Waiting")
        player.start()
        page.locator("#state", has_text="frames received").wait_for()
        brightest = int(np.argmax(steps.reshape(-1, 3)[:, 0]))
        red, green, blue = (round(value / 2.55, 1) for value in steps.reshape(-1, 3)[brightest])
        page.locator("#dome title", has_text=f"lamp {brightest}: {red:.1f} %, {green:.1f} %, {blue:.1f} %").wait_for(state="attached")
        # the colours of the pages are there
        page.wait_for_function("() => getComputedStyle(document.body).getPropertyValue('--paper') !== ''")
        keep(page, "twin", tmp_path)
        page.route("**/state.json", lambda route: route.abort())
        page.locator("#state", has_text="The twin does not answer").wait_for()
        page.unroute_all()
        page.locator("#state", has_text="frames received").wait_for()  # one that answers again has not ended
        stop.set()
        player.join()
        page.locator("#dome title", has_text=f"lamp {brightest}: 0.0 %, 0.0 %, 0.0 %").wait_for(state="attached")
        program.send_signal(signal.SIGINT)
        assert program.wait(timeout=120) == 0
        page.locator("#state", has_text="The twin has ended.").wait_for()
