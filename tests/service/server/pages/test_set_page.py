"""The page of the stage: a capture of the twin of a stage, from the first click to an asset, and a picture taken again."""

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from stage.capture.capture import Capture
from tests.scenes.captures import make_scene, write_capture
from tests.scenes.patched_rigs import loopback, write_rig_file
from tests.service.server.pages.conftest import PICTURES, SAMPLES, new_context
from tests.service.server_process import serving

ROOT = SAMPLES.parent
LAMPS = 7
DEAD = 5
"""The release at which no lamp shines: a dark picture and the chart are the first, so this is the third lamp."""


@contextmanager
def stage(folder: Path, *options: object):
    """A server with the page, whose lamps and camera are the twin of a small stage; yields the server and the folder of its captures."""
    scene, host, watched = make_scene(size=64, lights=LAMPS), loopback(), folder / "watched"
    rig = write_rig_file(folder / "rig.json", scene.directions, host=host, name="the little dome")
    capture = write_capture(folder / "scene", scene)
    command = [sys.executable, "-m", "service.cli.main", "twin", rig, capture, "--interface", host, "--port", "0", "--pictures", watched,
               "--picture-format", "png", "--noise", "0.003", *options]
    twin = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        assert twin.stdout.readline().startswith("twin ")
        page = twin.stdout.readline().split()[1].removesuffix(":")
        shoot = f"{sys.executable} -S -c \"import urllib.request as u; u.urlopen(u.Request('{page}/release', method='POST'))\""
        with serving(folder / "data", "--anonymous", "--device", "none", "--set", rig, "--camera", f"watch:{watched}", "--trigger", shoot
                     ) as server:
            yield server, server.data / "set"
    finally:
        twin.kill()
        twin.wait()


def test_only_programs_of_this_machine_reach_the_stage_and_bad_input_is_refused(tmp_path, relit):
    with stage(tmp_path) as (server, _), server.client() as client:
        good = {"name": "one", "plan": "olat"}
        for headers in ({"Host": "relit.example"}, {"Origin": "http://elsewhere.example"}):
            assert client.post("/set/run", json=good, headers=headers).status_code == 403
        for changes, words in (({"name": "../one"}, "no name of a capture"), ({"plan": "/etc/passwd"}, "none of olat"),
                               ({"plan": "gray"}, "--projector"), ({"trigger": "rm"}, "trigger")):
            answer = client.post("/set/run", json={**good, **changes})
            assert answer.status_code == 422 and words in answer.json()["detail"], answer.text
        assert client.get("/set/files/preview.png").status_code == 404 and client.get("/set/files/rig.json").status_code == 404
        assert client.get("/set/picture", params={"shot": "0001_light_001"}).status_code == 404
    assert "loopback" in relit.refused("serve", "--data", tmp_path / "other", "--host", "0.0.0.0", "--set", tmp_path / "rig.json",
                                       "--camera", "video:0")
    assert "--camera" in relit.refused("serve", "--data", tmp_path / "other", "--set", tmp_path / "rig.json")


@pytest.mark.long
def test_a_capture_from_the_first_click_to_an_asset(browser, tmp_path):
    with stage(tmp_path, "--faults", f"dead@{DEAD}") as (server, captures):
        context = new_context(browser, base_url=server.url, viewport={"width": 1280, "height": 900})
        page, errors = context.new_page(), []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if "Content Security Policy" in message.text else None)
        page.goto("/set")
        page.get_by_role("heading", name="Set: the little dome").wait_for()
        page.get_by_label("Capture").fill("ball")
        page.get_by_label("Plan").fill("dark,chart,olat")
        page.get_by_label("solve and export").check()
        page.get_by_role("button", name="Take the capture").click()
        page.locator("#prompt", has_text="put the colour chart in the place of the object").wait_for()
        page.get_by_role("button", name="Done").click()
        page.locator("#state", has_text="ended").wait_for()
        assert page.locator("#state").inner_text() == f"{LAMPS + 2} of {LAMPS + 2} pictures, 0 with a fault; ended"
        assert "asset.usdz" in page.locator("#lines").inner_text() and (captures / "ball" / "asset.usdz").exists()
        page.locator("#preview[data-shown]").wait_for()
        row = page.locator("tr[data-shot='0005_light_003']")
        assert "good, taken 2 times" in row.inner_text()
        page.locator("#dome title", has_text="lamp 2: good, taken 2 times").wait_for(state="attached")
        page.get_by_role("button", name="0006_light_004", exact=True).click()
        page.locator("#picture[data-shown*='0006_light_004']").wait_for()
        page.screenshot(path=Path(PICTURES or tmp_path) / "page_set.png")

        page.get_by_label("solve and export").uncheck()
        page.get_by_role("button", name="Take 0006_light_004 again").click()
        page.locator("tr[data-shot='0006_light_004']", has_text="good, taken 2 times").wait_for()
        page.locator("#state", has_text="ended").wait_for()
        assert len(Capture.open(captures / "ball").manifest.frames) == LAMPS + 1
        lines = [json.loads(line) for line in (captures / "ball" / "acquisition.jsonl").read_text().splitlines()]
        assert [line["shot"] for line in lines if line.get("was_taken")] == ["0006_light_004"]

        page.get_by_label("Capture").fill("light")
        page.get_by_label("Plan").fill("olat")
        page.get_by_role("button", name="Meter the light").click()
        page.locator("#metered[data-shown]").wait_for()
        assert json.loads((captures / "light" / "meter.json").read_text())["proposed"]["sure"] in (True, False)
        context.close()
        assert errors == []
