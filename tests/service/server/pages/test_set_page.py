"""The page of the stage: captures of the twin of a stage, from the first click to an asset, mended, metered, and under a projector."""

import json
from contextlib import contextmanager, suppress
from ctypes.util import find_library
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.acquisition.cameras.aravis_camera import LIBRARY
from stage.capture.capture import Capture
from tests.scenes.captures import make_scene, write_capture
from tests.scenes.patched_rigs import loopback, write_rig_file
from tests.scenes.video import write_video
from tests.service.acquisition.test_acquire import posting
from tests.service.server.pages.axe import assert_accessible
from tests.service.server.pages.conftest import PICTURES, SAMPLES, expect, keep, new_context, opened_page
from tests.service.server_process import serving
from tests.service.twin_program import twin_running

pytestmark = pytest.mark.long
LAMPS = 7
DEAD = "dead@5,dead@6,dead@7"
"""The releases at which no lamp shines: a dark picture and the chart are the first, so this is the third lamp, at every attempt."""


@contextmanager
def stage(folder: Path, *options: object, sample: bool = False, serve: tuple[object, ...] = ("--device", "none")):
    """A server with the page, whose lamps and camera are the twin of a small stage, or of that of the sample; yields the server and the
    folder of its captures."""
    host, watched = loopback(), folder / "watched"
    if sample:
        capture = SAMPLES / "owl"
        directions = np.array([frame["light"]["direction"] for frame in json.loads((capture / "capture.json").read_text())["frames"]])
    else:
        scene = make_scene(size=64, lights=LAMPS)
        capture, directions = write_capture(folder / "scene", scene), scene.directions
    rig = write_rig_file(folder / "rig.json", directions, host=host, name="the little dome")
    with twin_running(rig, capture, host, "--pictures", watched, "--picture-format", "png", "--noise", "0.001",
                      "--exposure", "-1" if sample else "0", "--cache", folder, *options) as (_, page), \
            serving(folder / "data", "--anonymous", "--set", rig, "--camera", f"watch:{watched}", "--trigger", posting(f"{page}/release"),
                    *serve) as server:
        yield server, server.data / "set"


@contextmanager
def opened(browser, server, **options):
    """The page of the stage."""
    with opened_page(browser, base_url=server.url, viewport={"width": 1280, "height": 900}, **options) as page:
        page.goto("/set")
        page.get_by_role("heading", name="Set: the little dome").wait_for()
        yield page


def assert_accessible_where_axe_is(page) -> None:
    with suppress(pytest.skip.Exception):
        assert_accessible(page, 390, 640, 1280)


def test_only_programs_of_this_machine_reach_the_stage_and_bad_input_is_refused(tmp_path, relit):
    with stage(tmp_path) as (server, _), server.client() as client:
        good = {"name": "one", "plan": "olat"}
        for headers in ({"Host": "relit.example"}, {"Origin": "http://elsewhere.example"}):
            assert client.post("/set/run", json=good, headers=headers).status_code == 403
        for changes, words in (({"name": "../one"}, "no name of a capture"), ({"plan": "/etc/passwd"}, "none of olat"),
                               ({"plan": "gray"}, "--projector"), ({"trigger": "rm"}, "trigger")):
            answer = client.post("/set/run", json={**good, **changes})
            assert answer.status_code == 422 and words in answer.json()["detail"], answer.text
        for name in ("one", "../data", ""):
            assert "no capture" in client.post("/set/open", json={"name": name}).json()["detail"]
        assert "no live view" in client.post("/set/look", json={"on": True}).json()["detail"]
        assert client.get("/set/files/preview.png").status_code == 404 and client.get("/set/files/rig.json").status_code == 404
        assert client.get("/set/picture", params={"shot": "0001_light_001"}).status_code == 404
        assert client.get("/set/live").status_code == 404
    refused = ["serve", "--data", tmp_path / "other"]
    given = ["--set", tmp_path / "rig.json", "--camera", "video:0"]
    assert "--projector" in relit.refused(*refused, *given, "--projector", "wide")
    for alone in (["--set", tmp_path / "rig.json"], ["--projector", "64x48"]):
        assert "--camera" in relit.refused(*refused, *alone)


def test_where_there_are_keys_an_administrator_alone_takes_captures_from_anywhere(browser, tmp_path, relit):
    """Under another name, as a tablet beside the stage asks for it; pictures come with the key too."""
    with stage(tmp_path, serve=("--device", "none", "--keys-only")) as (server, _):
        keys = {scope: relit("keys", "create", "--data", server.data, "--project", "larch", "--name", scope, "--scope", scope).out.strip()
                for scope in ("write", "admin")}
        elsewhere, good = {"Host": "stage.example", "Origin": "http://elsewhere.example"}, {"name": "ball", "plan": "dark"}
        with server.client() as client:
            for headers, status in (({}, 401), ({"Authorization": f"Bearer {keys['write']}"}, 403),
                                    ({"Authorization": f"Bearer {keys['admin']}", **elsewhere}, 204)):
                assert client.post("/set/run", json=good, headers=headers).status_code == status
        with opened_page(browser, base_url=server.url) as page:
            page.goto("/set")
            page.get_by_role("textbox", name="Key").fill(keys["admin"])
            page.get_by_role("button", name="Use this key").click()
            page.get_by_role("heading", name="Set: the little dome").wait_for()
            page.locator("#now", has_text="1 of 1 pictures").wait_for()
            page.locator("#picture[data-shown*='0001_dark'][src^='blob:']").wait_for()


def test_from_the_first_click_to_an_asset(browser, tmp_path):
    """With the keyboard alone; the sample is there for the picture of the documentation."""
    with stage(tmp_path, sample=PICTURES is not None, serve=("--device", "cpu")) as (server, captures):
        with opened(browser, server, bypass_csp=True, color_scheme="light") as page:  # axe is injected
            expect(page.locator("[data-step=chart]")).to_contain_text("The colours are those of the camera.")
            expect(page.get_by_role("button", name="Live view")).to_have_count(0)  # a watched folder has none
            expect(page.get_by_role("navigation").get_by_role("link", name="Set")).to_have_attribute("href", "/set")
            assert_accessible_where_axe_is(page)
            name = page.get_by_label("Capture", exact=True)
            for given, is_name in {"../owl": False, "an owl": False, "Büste_2-a": True, "owl": True}.items():
                name.fill(given)
                assert name.evaluate("(input) => input.checkValidity()") is is_name
            page.get_by_role("button", name="Colour chart: Add").press("Enter")
            expect(page.get_by_label("Plan")).to_have_value("dark,chart,olat")
            page.get_by_role("button", name="Colour chart: Leave out").press("Enter")
            page.get_by_role("button", name="Take the capture").press("Enter")
            page.get_by_role("button", name="Make an asset").wait_for()
            page.locator("canvas[data-turns=true]").wait_for()
            expect(page.locator("[data-step=object]")).to_contain_text("✓")
            expect(page.locator("[data-step=dark]")).to_contain_text("1 of 1 picture")
            assert_turns(page)
            assert_accessible_where_axe_is(page)
            page.evaluate("() => scrollTo(0, 0)")
            keep(page, "set", tmp_path)
            if PICTURES:  # to solve the sample takes minutes
                return
            page.get_by_role("button", name="Make an asset").press("Enter")
            page.get_by_role("link", name="Open the asset").wait_for()
            page.reload()  # what was made is found again, and made no second time
            page.locator("#captures option[value=owl]").wait_for(state="attached")
            page.get_by_role("link", name="Open the asset").press("Enter")
            page.get_by_role("heading", name="Asset of").wait_for()
        with server.client() as client:
            kinds = [job["request"]["kind"] for job in client.get("/v1/jobs").json()["jobs"]]
            assert sorted(kinds) == ["check", "export", "solve", "view"]
        assert not (captures / "owl" / "chart").exists()


def assert_turns(page) -> None:
    """The light turns while nobody points, follows the pointer and the arrow keys, and rests where motion is to be reduced."""
    direction = "() => relit.state().light.direction"
    before = page.evaluate(direction)
    page.wait_for_function(f"(before) => Math.hypot(...({direction})().map((each, axis) => each - before[axis])) > 0.1", arg=before)
    picture = page.locator("canvas.picture")
    height = picture.bounding_box()["height"]
    for x in (5, 6):  # a page that has stood still meanwhile follows the next move
        picture.hover(position={"x": x, "y": height / 2})
    page.wait_for_function(f"() => ({direction})()[0] < -0.5")  # it follows at once, and stays for a while
    before = page.evaluate(direction)[1]
    picture.press("ArrowUp")
    page.wait_for_function(f"(before) => ({direction})()[1] > before", arg=before)
    page.emulate_media(reduced_motion="reduce")
    page.locator("canvas[data-turns=false]").wait_for()
    page.get_by_role("button", name="Turn the light").press("Enter")
    page.locator("canvas[data-turns=true]").wait_for()


def test_a_fault_is_named_and_mended(browser, tmp_path):
    with stage(tmp_path, "--faults", DEAD) as (server, captures), opened(browser, server, bypass_csp=True) as page:
        page.get_by_label("Capture", exact=True).fill("ball")
        page.get_by_label("Plan").fill("dark,chart,olat")
        page.get_by_role("button", name="Take the capture").click()
        page.locator("#prompt", has_text="put the colour chart in the place of the object").wait_for()
        assert_accessible_where_axe_is(page)
        page.get_by_role("button", name="Done").click()
        mend = page.get_by_role("button", name="Take those with a fault again")
        mend.wait_for()
        expect(page.locator("#now")).to_contain_text(f"{LAMPS + 2} of {LAMPS + 2} pictures, 1 with a fault.")
        page.locator("#dome title", has_text="lamp 2: did not light: has 0").wait_for(state="attached")
        expect(page.locator("[data-step=object]")).to_contain_text("1 with a fault")
        assert_accessible_where_axe_is(page)
        page.get_by_role("button", name="0006_light_004", exact=True).click()
        page.locator("#picture[data-shown*='0006_light_004']").wait_for()
        page.evaluate("() => scrollTo(0, 0)")
        keep(page, "set_fault", tmp_path)

        page.get_by_role("button", name="Colour chart: Correct the colours").press("Enter")
        page.locator("#problem", has_text="no chart is found").wait_for()

        mend.press("Enter")
        page.locator("tr[data-shot='0005_light_003']", has_text="good, taken 4 times").wait_for()
        page.locator("#now", has_text="0 with a fault").wait_for()
        page.get_by_role("button", name="Retake 0006_light_004").press("Enter")
        page.locator("tr[data-shot='0006_light_004']", has_text="good, taken 2 times").wait_for()
        page.locator("#now", has_text="0 with a fault").wait_for()
        assert len(Capture.open(captures / "ball").manifest.frames) == LAMPS + 1
        lines = [json.loads(line) for line in (captures / "ball" / "acquisition.jsonl").read_text().splitlines()]
        assert [line["shot"] for line in lines if line.get("was_taken")] == ["0005_light_003", "0006_light_004"]


def test_what_is_missing_is_added_or_taken_alone_and_a_capture_is_shown_again(browser, tmp_path):
    with stage(tmp_path) as (server, captures), opened(browser, server) as page:
        page.get_by_label("Capture", exact=True).fill("ball")
        page.get_by_label("Plan").fill("dark")
        page.get_by_role("button", name="Take the capture").click()
        page.locator("#now", has_text="1 of 1 pictures").wait_for()
        page.get_by_role("button", name="Object: New capture with it").click()
        expect(page.get_by_label("Plan")).to_have_value("dark,olat")
        page.get_by_role("button", name="White card: Add").click()
        expect(page.get_by_label("Capture", exact=True)).to_have_value("ball-2")
        expect(page.get_by_label("Plan")).to_have_value("dark,flat,olat")
        page.get_by_role("button", name="Meter the light").click()
        page.locator("#metered[data-shown]").wait_for()
        page.locator("#now", has_text="The meter proposes").wait_for()
        assert json.loads((captures / "ball-2" / "meter.json").read_text())["proposed"]["sure"] in (True, False)

        page.get_by_label("Capture", exact=True).fill("ball")
        page.get_by_label("Capture", exact=True).press("Tab")
        page.locator("tr[data-shot='0001_dark']", has_text="good").wait_for()
        page.get_by_role("button", name="Ball: Take it now").click()
        page.locator("#prompt", has_text="put the mirror ball").wait_for()
        page.get_by_role("button", name="Stop").click()
        page.get_by_role("button", name="Take the capture").wait_for()
        expect(page.get_by_label("Capture", exact=True)).to_have_value("ball-ball")
        assert not list((captures / "ball-ball").glob("*.png"))


def test_brackets_tracking_pictures_and_lamps_are_chosen_on_the_page(browser, tmp_path):
    """A watched folder sets no exposure times, which its sentence says, and so the plan is judged."""
    with stage(tmp_path) as (server, captures), opened(browser, server, bypass_csp=True) as page:
        page.get_by_label("Capture", exact=True).fill("some")
        page.get_by_label("Plan").fill("olat")
        page.get_by_text("Exposures, tracking, lamps").click()
        times, tracking, lamps = (page.get_by_label(name) for name in ("Exposure times", "A tracking picture", "Lamps one by one"))
        lamps.fill(f"3-{LAMPS + 1}")
        page.get_by_role("button", name="Take the capture").click()
        page.wait_for_function("() => !document.getElementById('lights').validity.valid")
        lamps.fill("3-4, 6")
        for name in ("lamp 5:", "lamp 6:"):  # the sixth and the seventh
            page.locator("#dome circle").filter(has_text=name).click()
        expect(lamps).to_have_value("3-4, 7")
        tracking.fill("2")
        assert_accessible_where_axe_is(page)
        page.get_by_role("button", name="Take the capture").click()
        page.locator("#dome circle").filter(has_text="lamp 0:").click()  # for the next capture, whatever is told of this one meanwhile
        page.locator("#now", has_text="6 of 6 pictures").wait_for()
        expect(lamps).to_have_value("1, 3-4, 7")
        lines = [json.loads(line) for line in (captures / "some" / "acquisition.jsonl").read_text().splitlines()]
        taken = [line["shot"][5:] for line in lines if line.get("event") == "taken"]
        assert taken == ["tracking", "light_003", "light_004", "tracking", "light_007", "tracking"]

        page.get_by_label("Capture", exact=True).fill("other")
        lamps.fill("1")
        tracking.fill("")
        times.fill("1,5")
        page.get_by_role("button", name="Take the capture").click()
        assert times.evaluate("(field) => field.validationMessage") == "Write 1.5 for one time, or 1, 5 for two."
        times.fill("0.05, 0.2")
        page.get_by_role("button", name="Take the capture").click()
        page.locator("#problem", has_text="exposures_s").wait_for()  # a watched folder sets none without {exposure_s}
        plan = json.loads((captures / ".plans" / "other.json").read_text())
        assert plan["sequences"][0]["exposures_s"] == [0.05, 0.2] and plan["sequences"][0]["lights"] == ["lamp 0"]

        page.get_by_label("Capture", exact=True).fill("some")
        page.get_by_label("Capture", exact=True).press("Tab")
        expect(lamps).to_have_value("3-4, 7")
        expect(tracking).to_have_value("2")
        expect(times).to_have_value("")


def test_patterns_of_a_projector_whose_page_is_shown(browser, tmp_path):
    """A camera that sees the window of the projector pixel by pixel."""
    size, watched, released = (64, 48), tmp_path / "watched", tmp_path / "released"
    watched.mkdir()
    rig = write_rig_file(tmp_path / "rig.json", make_scene(size=8, lights=LAMPS).directions, host=loopback(), name="the little dome")
    with serving(tmp_path / "data", "--anonymous", "--device", "cpu", "--set", rig, "--camera", f"watch:{watched}", "--trigger",
                 f"touch {released}", "--projector", "64x48", "--projector-port", "0") as server, opened(browser, server) as page:
        page.get_by_label("Plan").fill("gray")
        page.get_by_role("button", name="Take the capture").click()
        link = page.locator("#projector-page")
        link.wait_for()
        window = new_context(browser, viewport={"width": size[0], "height": size[1]}).new_page()
        window.goto(link.get_attribute("href"))
        taken = 0
        while not page.locator("#now", has_text="0 with a fault").is_visible():
            if released.exists():
                released.unlink()
                taken += 1
                seen = cv2.imdecode(np.frombuffer(window.screenshot(), np.uint8), cv2.IMREAD_COLOR)
                cv2.imwrite(str(watched / f".{taken}.png"), (0.8 * seen).round().astype(np.uint8))  # white does not clip
                (watched / f".{taken}.png").rename(watched / f"{taken:04d}.png")
        window.context.close()
        frames = Capture.open(server.data / "set" / "capture").manifest.frames
        assert len(frames) == taken == 2 + 2 * 6  # white, black, and six bits of 64 columns with their inverses
        expect(link).to_be_hidden()
        page.get_by_role("button", name="Solve").click()
        page.get_by_role("link", name="Its maps").wait_for()
        expect(page.locator("#now")).to_contain_text("The patterns are decoded.")


def test_the_live_view_and_a_capture_of_a_machine_vision_camera(browser, tmp_path):
    """The camera that Aravis feigns shows a ramp that moves, whatever lamps shine."""
    if find_library(LIBRARY) is None:
        pytest.skip("the library Aravis is not installed")
    rig = write_rig_file(tmp_path / "rig.json", make_scene(size=8, lights=LAMPS).directions, host=loopback(), name="the little dome")
    with serving(tmp_path / "data", "--anonymous", "--device", "none", "--set", rig, "--camera", "aravis:Fake_1") as server, \
            opened(browser, server) as page:
        page.get_by_role("button", name="Live view").click()
        page.locator("#seen-words", has_text="% clipped").wait_for()
        page.wait_for_function("() => document.getElementById('seen-picture').naturalWidth > 0")
        page.get_by_label("Plan").fill("dark")
        page.get_by_role("button", name="Take the capture").click()
        page.locator("#now", has_text="1 of 1 pictures").wait_for()
        expect(page.locator("#seen")).to_be_hidden()
        settings = json.loads((server.data / "set" / "capture" / "report.json").read_text())["camera_settings"]
        assert settings["DeviceVendorName"] == "Aravis"


def test_the_live_view_says_what_clips_and_ends_before_a_capture(browser, tmp_path):
    frame = np.full((48, 64, 3), 90, np.uint8)
    frame[:, 32:] = 255
    path = write_video(tmp_path / "video.avi", [frame] * 30)
    rig = write_rig_file(tmp_path / "rig.json", make_scene(size=8, lights=LAMPS).directions, host=loopback(), name="the little dome")
    with serving(tmp_path / "data", "--anonymous", "--device", "none", "--set", rig, "--camera", f"video:{path}") as server, \
            opened(browser, server, bypass_csp=True) as page:
        live = page.get_by_role("button", name="Live view")
        live.press("Enter")
        page.locator("#seen-words", has_text="50.0 % clipped").wait_for()
        page.wait_for_function("() => document.getElementById('seen-picture').naturalWidth > 0")
        expect(live).to_have_attribute("aria-pressed", "true")
        assert_accessible_where_axe_is(page)
        page.get_by_label("Plan").fill("olat")
        page.get_by_role("button", name="Take the capture").click()
        page.locator("#now", has_text=f"{LAMPS} of {LAMPS} pictures").wait_for()
        expect(live).to_have_attribute("aria-pressed", "false")
        expect(page.locator("#seen")).to_be_hidden()
