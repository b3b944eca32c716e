"""An object on one page: modes that it has, an address that says what is shown, maps compared, files, and a video."""

import re

import numpy as np
import pytest

from tests.service.server.pages.axe import assert_accessible
from tests.service.server.pages.conftest import Solved, alter, await_whole, done, expect, new_context, opened_page, seen, spread_fingers
from tests.service.server.pages.frames import picture

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def made(server, client, solved) -> Solved:
    """The small sample, solved twice and exported."""
    other = done(server, client, {"kind": "solve", "capture": solved.capture, "name": "<i>other", "options": {"method": "robust"}})
    done(server, client, {"kind": "export", "maps": other})
    return solved


def mode(page, name: str, content: str) -> None:
    page.get_by_role("group", name="What is shown").get_by_role("button", name=name, exact=True).click()
    page.locator(content).first.wait_for()


def test_the_modes_of_an_object_are_those_that_exist_and_stand_in_the_address(small_page, made):
    page = small_page
    made.open(page, "object")
    expect(page.locator("#modes button:not([data-mode=frames])")).to_have_text(["Light", "Maps", "3-D", "Photographs", "Compare"])
    for name in ("asset.usdz", "maps.exr"):
        expect(page.locator("#files").get_by_role("link", name=name, exact=True)).to_be_visible()
    mode(page, "Maps", "[data-shows=maps] canvas.map")
    page.wait_for_function("() => location.hash.includes('mode=maps')")
    mode(page, "3-D", "canvas.scene")
    page.wait_for_function("() => globalThis.asset?.state().triangles > 1000")
    mode(page, "Photographs", "[data-shows=photographs] figure canvas")
    page.wait_for_function("() => location.hash.includes('mode=photographs')")
    page.goto("/jobs")
    page.go_back()
    page.locator("[data-shows=photographs] figure canvas").first.wait_for()
    await_whole(page)
    expect(page.locator("[data-shows=light]")).to_have_count(0)  # what is not looked at is not loaded
    with page.expect_download() as download:
        page.locator("#files a", has_text="maps.exr").click()
    assert download.value.path().read_bytes()[:4] == b"\x76\x2f\x31\x01"


def test_back_and_forward_go_through_the_modes_as_they_were_left(small_page, made):
    page, errors = small_page, []
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.goto("/jobs")
    made.open(page, "object")
    page.get_by_label("Size of the light in degrees").fill("12")
    mode(page, "Maps", "[data-shows=maps] canvas.map")
    page.get_by_label("Layer", exact=True).select_option("normal")
    mode(page, "Photographs", "[data-shows=photographs] figure canvas")
    page.evaluate("globalThis.isFirstDocument = true")
    ways = (("go_back", "maps"), ("go_back", "light"), ("go_forward", "maps"), ("go_forward", "photographs"), ("go_back", "maps"))
    for way, name in ways:
        getattr(page, way)()
        expect(page.locator("[data-shows]:visible")).to_have_attribute("data-shows", name)
        expect(page.locator("#modes [aria-pressed=true]")).to_have_attribute("data-mode", name)
        page.wait_for_function("() => location.hash.includes('size=12')")
    assert page.evaluate("globalThis.isFirstDocument") is True  # nothing was loaded again
    page.evaluate("location.hash = '#mode=photographs&size=3'")  # a link that shows something else than what was left
    page.wait_for_function("() => globalThis.isFirstDocument === undefined")
    page.locator("[data-shows=photographs] figure canvas").first.wait_for()
    for name in ("maps", "light"):
        page.go_back()
        page.locator(f"[data-shows={name}]:visible").wait_for()
    page.go_back()
    page.wait_for_url("**/jobs")
    assert errors == []


def test_the_link_to_the_content_keeps_what_the_address_says(small_page, made):
    page = small_page
    page.goto(f"{made.pages['object']}#mode=photographs&size=9")
    page.locator("[data-shows=photographs] figure canvas").first.wait_for()
    await_whole(page)
    page.keyboard.press("Tab")
    expect(page.locator(".skip")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#main")).to_be_focused()
    page.wait_for_function("() => location.hash === '#mode=photographs&size=9'")


def test_what_is_being_prepared_is_said_where_it_will_be_shown_and_in_no_other_mode(small_page, made):
    page = small_page
    alter(page, "**/v1/jobs?kind=view&limit=500&state=succeeded&state=queued&state=running", lambda found: found | {
        "jobs": [{**job, "state": "running"} if job["request"].get("maps") else job for job in found["jobs"]]})
    page.route("**/v1/jobs/*/events", lambda route: None)  # it never ends
    page.goto(f"{made.pages['object']}#mode=photographs")
    page.locator("[data-shows=photographs] figure canvas").first.wait_for()
    mode(page, "Maps", "[data-shows=maps] progress")
    page.get_by_text("its view is being prepared").wait_for()
    mode(page, "Photographs", "[data-shows=photographs] figure canvas")
    expect(page.locator("progress:visible")).to_have_count(0)
    expect(page.get_by_text("its view is being prepared")).to_be_hidden()


def test_a_job_under_way_that_goes_on_with_the_maps_of_an_object_is_on_its_page(client, small_page, made):
    jobs = client.get("/v1/jobs", params={"limit": 500, "kind": "export"}).json()["jobs"]
    waiting = {**jobs[0], "state": "queued"}
    foreign = {**waiting, "id": "job_0123456789abcdefghjk", "request": {**waiting["request"], "maps": "job_x123456789abcdefghjk"}}
    page, listed = small_page, {"jobs": [waiting, foreign], "next": None}
    page.route("**/v1/jobs?limit=500&state=running&state=queued", lambda route: route.fulfill(json=listed))
    page.route(f"**/v1/jobs/{waiting['id']}", lambda route: route.fulfill(json=waiting))
    page.route("**/v1/events", lambda route: None)  # nothing happens to it
    page.goto(f"{made.pages['object']}#mode=photographs")
    page.locator(f"#work li[data-job={waiting['id']}]", has_text="waits for a free worker").wait_for()
    await_whole(page)  # all that are under way are listed
    expect(page.locator("#work li")).to_have_count(1)  # none of other objects


@pytest.mark.parametrize("mode", ["photographs", "light"])
def test_what_was_taken_for_granted_is_no_fault(page, made, mode):
    doubts = {"findings": ["a frame is dark"], "warnings": ["the height is steep", "no lens is known"], "assumed": ["no lens is known"]}
    alter(page, "**/results/view.json", lambda view: view | doubts)
    page.goto(f"{made.pages['object']}#mode={mode}")
    colours = [page.get_by_text(words, exact=True).evaluate("(each) => getComputedStyle(each).color")
               for words in ("a frame is dark", "the height is steep", "no lens is known")]
    assert len(set(colours)) == 3
    expect(page.locator(".assumed li")).to_have_count(1)


def test_every_slider_has_its_number(page, made):
    made.open(page, "light")
    page.get_by_label("Size of the light in degrees").fill("12.5")
    page.evaluate("relit.set([0.3, 0.1, 0.9])")
    expect(page.locator(".panel input[type=range]")).to_have_count(6)
    page.wait_for_function("""() => [...document.querySelectorAll(".panel input[type=range]")].every((slider) =>
      Number(slider.parentElement.querySelector("output").textContent.replace("\u2212", "-")) === Number(slider.value))""")


def test_a_capture_that_an_earlier_build_has_checked_is_offered_what_its_light_allows(page, solved):
    """Its facts do not say what lit its frames; its view has their directions."""
    alter(page, f"**/v1/captures/{solved.capture}", lambda capture: capture | {
        "facts": {name: fact for name, fact in capture["facts"].items() if name != "lit_by"}})
    page.goto(solved.pages["capture"])
    expect(page.locator("#next [data-kind]:visible")).to_have_text(["Make an asset", "Solve normals and materials"])


def test_two_solves_are_compared_by_wipe_difference_and_side_by_side(page, made):
    page.goto(f"{made.pages['object']}#mode=compare")
    page.locator("[data-shows=compare] canvas.map").wait_for()
    expect(page.get_by_label("Maps", exact=True).locator("option:checked")).to_have_text(re.compile(r"^<i>other \("))
    how = page.locator("label", has_text="How").locator("select")

    def shown() -> np.ndarray:
        return np.array(page.locator("canvas.map").evaluate("""(canvas) => {
          const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
          const sums = [0, 0];
          for (let at = 0; at < data.length; at += 4) {
            sums[(at / 4) % canvas.width < canvas.width / 2 ? 0 : 1] += data[at] + data[at + 1] + data[at + 2];
          }
          return sums;
        }""")) / 1e3

    page.wait_for_function("""() => { const canvas = document.querySelector("canvas.map");
      return canvas.getContext("2d").getImageData(canvas.width / 2 - 20, canvas.height / 2, 1, 1).data[3] === 255
        && canvas.getContext("2d").getImageData(canvas.width / 2 + 20, canvas.height / 2, 1, 1).data[3] === 255; }""")
    wiped = shown()
    how.select_option("difference")
    page.wait_for_function("() => location.hash.includes('how=difference')")
    # the two solves agree on the normals of a Lambertian object but for unsure pixels
    seen(page, lambda: (shown() < 0.3 * wiped).all(), "the difference is not small")
    how.select_option("beside")
    page.wait_for_function("() => location.hash.includes('how=beside')")
    page.reload()
    page.locator("[data-shows=compare] canvas.map").wait_for()
    expect(how).to_have_value("beside")
    page.get_by_label("Layer", exact=True).select_option("sigma")
    expect(page.get_by_label("Compare with", exact=True)).to_have_value("0/sigma")
    page.get_by_label("Highest value that is shown").fill("1")

    def brightest() -> bool:
        """Return whether both show what lies above the highest value in the last colour of viridis, but for edges and hatching."""
        shares = page.locator("canvas.map").evaluate("""(canvas) => {
          const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height), counts = [[0, 0], [0, 0]];
          for (let at = 0; at < data.length; at += 4) {
            if (data[at + 3] < 255 || Math.abs(data[at] - data[at + 1]) + Math.abs(data[at] - data[at + 2]) < 60) continue;
            const half = counts[(at / 4) % canvas.width < canvas.width / 2 ? 0 : 1];
            half[Number(data[at] > 240 && data[at + 1] > 220)] += 1;
          }
          return counts.map(([others, yellow]) => yellow / (others + yellow));
        }""")
        return min(shares) > 0.9

    seen(page, brightest, "the two are shown by different ranges")


def test_the_maps_of_any_solve_are_shown(page, made):
    page.goto(f"{made.pages['object']}#mode=maps")
    chosen = page.get_by_label("Maps of")
    expect(chosen.locator("option")).to_have_text([re.compile(r"^<i>other \("), re.compile(r"^lambert \(")])
    page.locator("canvas.map").wait_for()
    with page.expect_response(f"**/v1/jobs/{made.solve}"):
        chosen.select_option(index=1)
    page.locator("canvas.map").wait_for()
    page.wait_for_function("(solve) => location.hash.includes(`of=${solve}`)", arg=made.solve)
    page.reload()  # as a link that was sent
    page.locator("canvas.map").wait_for()
    expect(chosen.locator("option:checked")).to_have_text(re.compile(r"^lambert \("))


def test_a_link_shows_what_its_sender_saw_and_back_returns_to_it(page, browser, made, sky):
    made.open(page, "light")
    page.get_by_label("Environment map").select_option(sky)
    page.locator("canvas.preview").wait_for()
    page.wait_for_function("() => relit.state().light === null")  # the environment is seen alone at first
    page.get_by_label("Turn of the environment in degrees").fill("40")
    page.evaluate("relit.set([-0.3, 0.2, 0.9])")
    page.get_by_label("Size of the light in degrees").fill("12")
    page.locator("canvas.picture").focus()
    for key in ("+", "+", "Shift+ArrowRight"):
        page.keyboard.press(key)
    page.wait_for_function("() => ['zoom=1.563', 'size=12', 'turn=40'].every((each) => location.hash.includes(each))")
    link, before, state = page.url, picture(page), page.evaluate("relit.state()")
    other = new_context(browser, viewport={"width": 900, "height": 700}).new_page()
    other.goto(link)
    made.wait_for_content(other, "light")
    assert np.abs(picture(other) - before).max() <= 2 / 255  # the direction is kept with three decimals
    assert other.evaluate("relit.state().exposure") == state["exposure"]
    other.close()
    page.goto("/jobs")
    page.go_back()
    made.wait_for_content(page, "light")
    assert np.abs(picture(page) - before).max() <= 2 / 255
    page.evaluate("location.hash = '#light=nonsense&size=1000&environment=env_0123456789abcdefghjk&colour=javascript'")
    page.get_by_role("alert").get_by_text("The environment of this address is not on this server").wait_for()
    page.wait_for_function("() => globalThis.relit?.state().environment === null")


def test_a_zoomed_picture_is_smooth_has_a_scale_bar_and_fills_the_screen(page, made):
    page.goto(f"{made.pages['light']}#zoom=4")
    made.wait_for_content(page, "light")
    width, height, largest = page.locator("canvas.picture").evaluate("""(canvas) => {
      const { width, height } = canvas;
      const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
      let largest = 0;
      for (let at = 4; at < data.length; at += 4) if ((at / 4) % width > 0) largest = Math.max(largest, Math.abs(data[at] - data[at - 4]));
      return [width, height, largest];
    }""")
    source = picture(page)
    scale = 4 * min(width, height) / len(source)
    assert 0 < largest < 2 * 255 * np.abs(np.diff(source[..., 0], axis=1)).max() / scale  # a block of a pixel's colour ends in a whole step
    expect(page.locator(".scale-bar")).to_have_text(re.compile(r"\d (mm|cm|µm)$"))
    page.get_by_role("button", name="Full screen").click()
    page.wait_for_function("() => document.fullscreenElement?.classList.contains('stage')")
    page.evaluate("document.exitFullscreen()")


def test_two_fingers_zoom_the_picture(browser, server, made):
    with opened_page(browser, base_url=server.url, has_touch=True, viewport={"width": 390, "height": 800}) as page:
        made.open(page, "light")
        spread_fingers(page.locator("canvas.picture"))
        page.wait_for_function("() => location.hash.includes('zoom=2')")


def test_notes_are_kept_with_the_object_at_their_places(page, made, browser):
    made.open(page, "light")
    page.get_by_role("button", name="Add a note").click()
    expect(page.locator(".marking")).to_be_focused()
    page.keyboard.press("Enter")
    page.get_by_label("Text of the note").fill("<img src=x onerror=alert(1)> the middle")
    page.get_by_role("button", name="Keep the note").click()
    page.locator(".notes > button").first.wait_for()
    page.get_by_role("button", name="Add a note").click()
    expect(page.locator(".marking")).to_be_focused()
    box = page.locator(".marking").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 60, middle[1] + 40)
    page.mouse.up()
    page.get_by_label("Text of the note").fill("a region")
    page.get_by_role("button", name="Keep the note").dblclick()
    page.locator(".notes > button").nth(1).wait_for()
    page.locator("canvas.picture").focus()
    page.keyboard.press("+")  # the marks go with the picture
    page.wait_for_function("() => document.querySelectorAll('.notes .area')[1].offsetWidth > 70")
    other = new_context(browser).new_page()
    other.goto(page.url)
    made.wait_for_content(other, "light")
    expect(other.locator(".notes-list li")).to_have_text(["<img src=x onerror=alert(1)> the middle Delete", "a region Delete"])
    expect(other.locator("main img")).to_have_count(0)
    expect(other.locator(".notes > button")).to_have_count(2)
    other.wait_for_function("""() => {
      const boxes = [...document.querySelectorAll("canvas.picture, .notes > button")].map((each) => each.getBoundingClientRect());
      const [[x, y], ...marks] = boxes.map(({ left, right, top, bottom }) => [(left + right) / 2, (top + bottom) / 2]);
      return marks.every(([u, v]) => Math.abs(u - x) < 2 && Math.abs(v - y) < 2);
    }""")  # both begin in the middle of the picture
    for left in (1, 0):
        other.get_by_role("button", name="Delete note 1").click()
        other.wait_for_function("(left) => document.querySelectorAll('.notes-list li').length === left", arg=left)
    other.close()


def test_a_video_is_recorded_by_the_browser(page, made):
    made.open(page, "light")
    page.wait_for_function("() => globalThis.relit?.state().light")
    before = page.evaluate("relit.state().light.direction")
    with page.expect_download() as download:
        page.get_by_role("button", name="Save a video").click()
    assert download.value.suggested_filename == "lambert.webm"
    assert download.value.path().read_bytes()[:4] == b"\x1aE\xdf\xa3"  # EBML, of which WebM is made
    assert np.allclose(page.evaluate("relit.state().light.direction"), before, atol=0.01)  # once around


@pytest.mark.parametrize("shown", ["light", "compare", "photographs", "maps", "3d"])
def test_each_mode_has_no_violation_and_fits_a_phone(open_to_axe, made, shown):
    open_to_axe.goto(f"{made.pages['object']}#mode={shown}")
    open_to_axe.locator(f"[data-shows='{shown}'] canvas").first.wait_for()
    await_whole(open_to_axe)
    assert_accessible(open_to_axe, 1280, 640, 390)
