"""Live relighting shows what `relit relight` makes, and sends exactly that to the batch."""

import json
import re
import shutil

import numpy as np
import pytest

from service.client import Client
from stage.colour.colour import rgb_matrix
from stage.formats import exr
from tests.reference.colour import srgb
from tests.scenes.captures import edit_manifest, write_exr
from tests.service.server.pages.conftest import SAMPLES, WITHOUT_WEBGL, Solved, done, expect, seen
from tests.service.server.pages.frames import assert_same, picture, rendered

pytestmark = pytest.mark.long
CAPTURED = 7
"""A light of the sample, from whose direction its photograph is compared."""


@pytest.fixture
def opened(page, solved):
    solved.open(page, "light")
    return page


def prepared_view(client, capture: str) -> dict:
    """What was prepared of a capture alone, whatever else the server has prepared."""
    view = next(job for job in client.get("/v1/jobs", params={"kind": "view", "limit": 500}).json()["jobs"]
                if job["request"]["capture"] == capture and job["request"].get("maps") is None)
    return client.get(f"/v1/jobs/{view['id']}/results/view.json").json()


def test_the_key_light_shows_what_the_batch_renders(opened, solved, tmp_path):
    opened.get_by_label("Size of the light in degrees").fill("10")
    shown = picture(opened)
    assert_same(shown, *rendered(opened, solved, tmp_path))


def test_frames_under_a_light_alone_turn_it_as_spin_does(opened, solved):
    """What is shown after a quarter of the turn is the second of four frames."""
    opened.get_by_label("Frames", exact=True).last.fill("4")
    lights = json.loads(opened.locator("[data-shows=keys]").text_content())["lights"]
    assert [key["frame"] for key in lights[0]["keys"]] == [1, 2, 3, 4]
    opened.evaluate("relit.turn(90)")
    assert np.allclose(opened.evaluate("relit.state().light.direction"), lights[0]["keys"][1]["direction"], atol=1e-9)
    opened.locator("output", has_text=re.compile(r"from the camera, \d+° up, \d+° to the left")).wait_for()


def test_coefficient_images_that_come_late_are_counted_beside_the_rest_of_the_page(page, solved):
    held, is_open = [], []
    page.route("**/results/view.bin", lambda route: route.continue_() if is_open else held.append(route))
    page.goto(solved.pages["object"])
    page.get_by_text(re.compile("^0 of [0-9]+ coefficient images are here")).wait_for()
    expect(page.get_by_role("button", name="Photographs")).to_be_visible()
    is_open.append(True)
    for route in held:
        route.continue_()
    solved.wait_for_content(page, "light")
    expect(page.locator(".coming")).to_have_count(0)


def test_a_photograph_leads_to_it_beside_the_light(client, page, solved):
    page.goto(f"{solved.pages['object']}#mode=photographs")
    page.locator("[data-shows=photographs] figure a").nth(CAPTURED).click()
    solved.wait_for_content(page, "light")
    expect(page.get_by_label("Photograph to compare with")).to_have_value(str(CAPTURED))
    frame = prepared_view(client, solved.capture)["frames"][CAPTURED]
    assert np.allclose(page.evaluate("relit.state().light.direction"), frame["direction"], atol=2e-3)  # of three decimals


def test_dragging_moves_the_light_and_light_from_beyond_the_captured_is_said(opened):
    box = opened.locator("canvas.picture").bounding_box()
    opened.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    opened.mouse.down()
    direction = "() => relit.state().light.direction"
    seen(opened, lambda: np.allclose(opened.evaluate(direction), [0, 0, 1], atol=0.02))
    side = min(box["width"], box["height"])
    opened.mouse.move(box["x"] + box["width"] / 2 - 0.3 * side, box["y"] + box["height"] / 2 - 0.2 * side)
    opened.mouse.up()
    seen(opened, lambda: np.allclose(opened.evaluate(direction), [-0.6, 0.4, np.sqrt(1 - 0.52)], atol=0.03))
    opened.evaluate("() => relit.set([0, 0, -1])")
    opened.get_by_text("100 % of the light comes from beyond the captured lights").wait_for()
    expect(opened.locator("canvas.picture.hatched")).to_be_visible()
    expect(opened.locator("output", has_text="from the camera")).to_contain_text("beyond the captured lights")
    opened.evaluate("() => relit.set([0, 0, 1])")
    opened.locator("canvas.picture:not(.hatched)").wait_for()


def test_the_error_of_the_basis_and_the_rate_of_pictures_are_shown(client, opened, solved):
    """The error is the one that was measured when the basis was made; the rate appears when something moves."""
    relight = prepared_view(client, solved.capture)["relight"]
    opened.locator(".figures > summary").click()
    expect(opened.locator(".figures")).to_contain_text(f"under {relight['held_out']['key_lights']} lights that the basis was not made from")
    expect(opened.locator(".figures p").first).to_be_visible()
    said = opened.locator(".figures").inner_text()
    assert float(re.search(r": ([\d.e-]+) of 255 levels off", said)[1]) == pytest.approx(relight["held_out"]["mean_levels"], rel=0.05)
    assert f"{relight['terms']} coefficient images of 0.016 megapixels" in said and relight["terms"] <= 32
    assert opened.evaluate("() => relit.figures().framesPerSecond") is None
    opened.set_input_files("input[accept='.exr,.hdr']", SAMPLES / "owl" / "environment.exr")
    opened.locator("canvas.preview").wait_for(timeout=60_000)
    opened.get_by_role("button", name="Spin").click()
    opened.locator("[data-shows=speed]", has_text="pictures a second").wait_for(timeout=60_000)


def test_nothing_is_drawn_while_nothing_changes(page, solved):
    page.add_init_script("""const draw = WebGL2RenderingContext.prototype.drawArrays;
      globalThis.drawn = 0;
      WebGL2RenderingContext.prototype.drawArrays = function (...given) { globalThis.drawn += 1; return draw.apply(this, given); };""")
    frames = """() => new Promise((done) => {
      let left = 10;
      const next = () => (left-- > 0 ? requestAnimationFrame(next) : done(drawn));
      next();
    })"""
    solved.open(page, "light")
    before = page.evaluate(frames)
    assert before > 0 and page.evaluate(frames) == before
    page.get_by_label("Exposure in stops").fill("1")
    page.wait_for_function("(before) => drawn > before", arg=before)
    seen(page, lambda: page.evaluate(frames) == page.evaluate(frames), "it is drawn again and again")


def test_arrow_keys_move_the_light(page, solved):
    """Also while the first picture stands for one that is still loaded."""
    held, holds = [], [True]
    page.route("**/view.bin", lambda route: held.append(route) if holds[0] else route.continue_())
    page.goto(f"/light/{solved.capture}")
    page.locator("canvas.picture[data-shown=card]").press("ArrowRight")
    seen(page, lambda: held, "no block is asked for")
    holds[0] = False
    while held:
        held.pop().continue_()
    solved.wait_for_content(page, "light")
    assert page.evaluate("() => relit.state().light.direction[0]") > 0.46  # 0.45 at first
    expect(page.get_by_label("View transform")).to_have_value("srgb")
    before = page.evaluate("() => relit.state().light.direction")
    page.locator("canvas.dome").focus()
    page.keyboard.press("ArrowRight")
    after = seen(page, lambda: (now := page.evaluate("() => relit.state().light.direction")) != before and now)
    assert np.degrees(np.arccos(np.dot(before, after))) == pytest.approx(5, abs=1.5) and after[0] > before[0]


def test_a_photograph_is_compared(client, opened, solved, tmp_path):
    """At the left end of the wipe, all of the picture is the photograph, as its coefficient images keep it."""
    opened.get_by_label("Photograph to compare with").select_option(str(CAPTURED))
    opened.get_by_label("Where the two pictures meet").fill("0")
    shown = picture(opened)
    exposure = opened.evaluate("() => relit.state().exposure")
    frames = prepared_view(client, solved.capture)["frames"]
    image = [frame["image"] for frame in frames if frame["direction"] is not None][CAPTURED]
    keys = {"schema": "relit.keys/1", "captured": [{"image": image, "keys": [{"frame": 1, "weight": 1}]}]}
    job = done(solved.server, client, {"kind": "relight", "capture": solved.capture, "keys": keys, "options": {"exposure": exposure}})
    channels, _ = exr.read(solved.result(job, "frame.0001.exr", tmp_path))
    assert_same(shown, srgb(np.stack([channels[c] for c in "RGB"], axis=-1)), channels["A"])


def test_without_webgl_it_is_said(page, solved):
    page.add_init_script(WITHOUT_WEBGL)
    page.goto(solved.pages["light"])
    page.get_by_text("This browser has no WebGL2").wait_for(timeout=60_000)
    expect(page.get_by_role("button", name="Render")).to_be_visible()


@pytest.mark.parametrize("turn", ["0", "130"])
def test_an_environment_shows_what_the_batch_renders(page, solved, sky, tmp_path, turn):
    solved.open(page, "light")
    page.get_by_label("On", exact=True).uncheck()
    page.get_by_label("Environment map").select_option(sky)
    page.locator("canvas.preview").wait_for(timeout=60_000)
    page.get_by_label("Turn of the environment in degrees").fill(turn)
    page.get_by_role("button", name="Expose for this light").click()
    shown = picture(page)
    assert_same(shown, *rendered(page, solved, tmp_path))


@pytest.fixture(scope="module")
def aces(server, client, tmp_path_factory) -> Solved:
    """The sample as a capture whose colours are ACEScg."""
    folder = shutil.copytree(SAMPLES / "lambert", tmp_path_factory.mktemp("aces") / "aces")
    edit_manifest(folder, name="aces", color_space="lin_ap1_scene")
    for image in folder.glob("*.exr"):
        channels, _ = exr.read(image)
        exr.write(image, channels, color_space="lin_ap1_scene", metadata={})
    with Client(server.url) as uploading:
        capture = uploading.captures.upload(folder).id
    done(server, client, {"kind": "view", "capture": capture})
    return Solved(server, capture, "")


@pytest.fixture(scope="module")
def wide_skies(server, tmp_path_factory) -> dict[str, str]:
    """The sample's environment, its colours made saturated, in ACEScg, which files declare by chromaticities alone, or as OpenImageIO 2."""
    channels, _ = exr.read(SAMPLES / "owl" / "environment.exr")
    rgb = np.stack([channels[c] for c in "RGB"], axis=-1) * np.linspace((0.1, 1, 3), (3, 1, 0.1), channels["R"].shape[1])
    wide, folder = rgb @ rgb_matrix("lin_rec709_scene", "lin_ap1_scene").T, tmp_path_factory.mktemp("wide")
    declared = {"solved": {"chromaticities": exr.chromaticities("lin_ap1_scene")}, "aces": {"oiio:ColorSpace": "ACEScg"}}
    with Client(server.url) as client:
        return {capture: client.environments.upload(write_exr(folder / f"{capture}.exr", wide, **header)).id
                for capture, header in declared.items()}


@pytest.mark.parametrize("capture", ["solved", "aces"])
def test_colours_are_converted_as_the_batch_converts_them(page, capture, wide_skies, tmp_path, request):
    """A key light is chosen in the colours of the screen, and maps and captures have colour spaces of their own."""
    shown_capture = request.getfixturevalue(capture)
    shown_capture.open(page, "light")
    page.get_by_label("Size of the light in degrees").fill("10")
    page.locator("input[type=color]").fill("#ff4020")
    page.get_by_label("Environment map").select_option(wide_skies[capture])
    page.locator("canvas.preview").wait_for(timeout=60_000)
    page.get_by_role("button", name="Expose for this light").click()
    shown = picture(page)
    assert_same(shown, *rendered(page, shown_capture, tmp_path))


def test_a_file_that_is_no_environment_or_of_an_unknown_colour_space_is_named(opened, tmp_path):
    broken, odd = tmp_path / "broken.exr", tmp_path / "odd.exr"
    broken.write_bytes(b"nothing")
    write_exr(odd, np.ones((8, 16, 3)), chromaticities=(0.5, 0.3, 0.3, 0.5, 0.2, 0.1, 0.33, 0.33))
    for path, words in ((broken, "cannot be read as an environment map"), (odd, "has chromaticities of no known colour space")):
        opened.set_input_files("input[accept='.exr,.hdr']", path)
        opened.get_by_role("alert").get_by_text(f"{path.name}: {words}").wait_for(timeout=60_000)


def test_an_environment_that_comes_after_another_was_chosen_lights_nothing(opened, sky):
    """The test reads the environment once more when the page has got it: by then the page has read it too."""
    held, path = [], f"/v1/environments/{sky}/file"
    opened.route(f"**{path}", lambda route: route.continue_() if held else held.append(route))
    opened.get_by_label("Environment map").select_option(sky)
    seen(opened, lambda: held, "the environment is not asked for")
    opened.get_by_label("Environment map").select_option("")
    with opened.expect_response(f"**{path}") as answered:
        held[0].continue_()
    answered.value.finished()
    opened.evaluate("""async (path) => {
      const { readEnvironment } = await import("/static/view/light/environment_map.js");
      await readEnvironment(await (await fetch(path)).arrayBuffer(), "sky.exr", "lin_rec709_scene");
    }""", path)
    assert opened.evaluate("relit.state().environment") is None and opened.evaluate("relit.state().light") is not None


def test_a_local_environment_is_shown_spins_and_is_not_sent(opened):
    opened.set_input_files("input[accept='.exr,.hdr']", SAMPLES / "owl" / "environment.exr")
    opened.locator("canvas.preview").wait_for(timeout=60_000)
    before = picture(opened)
    opened.get_by_role("button", name="Spin").click()
    opened.wait_for_function("""() => {
      const turn = relit.state().environment.turn_degrees;
      if (turn < 30 || turn > 330) return false;
      [...document.querySelectorAll("button")].find((button) => button.textContent === "Spin").click(); // before it is back
      return true;
    }""")
    seen(opened, lambda: np.abs(picture(opened) - before).mean() > 1 / 255)
    opened.get_by_role("button", name="Render").click()
    opened.get_by_text("environment.exr is a file of this machine: upload it").first.wait_for()
    assert "/light/" in opened.url
