"""The home page: a wall of cards that does not freeze with a thousand captures and is searched and sorted, and jobs that say why they
wait."""

import json
import re
from urllib.parse import parse_qs, urlsplit

import pytest

from service.requests.keys import Scope
from tests.service.server.pages.conftest import await_whole, expect, opened_page, page_of, seen
from tests.service.server_process import serving

CAPTURES = 1000
EVIL = '<img src=x onerror="document.title=1"><script>document.title=1</script>'
SHOWN = 60
"""Cards that the page adds at once."""


def capture(number: int, **facts) -> dict:
    """A capture as the API gives it."""
    return {"id": f"cap_{number:020d}", "name": f"bird {number}", "state": "ready", "registered": True, "problem": None, "view": None,
            "facts": {"captures": 1, "frames": 96, "resolution": [320, 320]} | facts,
            "created_at": f"2026-01-{1 + number % 28:02d}T10:00:00Z"}


def job(number: int, state: str, **values) -> dict:
    return {"id": f"job_{number:020d}", "state": state, "attempt": 1, "revision": 1, "priority": 50, "progress": None, "error": None,
            "request": {"kind": "solve", "capture": f"cap_{number:020d}", "name": ""}, "created_at": f"2026-01-01T10:00:{number:02d}Z",
            "started_at": None, "finished_at": None} | values


@pytest.fixture
def bare(browser, without_worker):
    """A page of a service that has nothing."""
    with page_of(browser, without_worker) as opened:
        yield opened


def pretend(page, captures: list[dict], jobs: list[dict] = []) -> list[dict]:  # noqa: B006
    """Let the API answer with these captures and jobs; return the bodies of the jobs that the page submits."""
    submitted: list[dict] = []

    def answer(route):
        request = route.request
        path, query = urlsplit(request.url).path, parse_qs(urlsplit(request.url).query)
        if request.method == "POST":
            submitted.append(json.loads(request.post_data))
            route.fulfill(status=202, json=job(99, "queued"))
        elif path == "/v1/captures":
            begin = next((at + 1 for at, each in enumerate(captures) if each["id"] == query.get("before", [""])[0]), 0)
            part = captures[begin : begin + int(query["limit"][0])]
            route.fulfill(json={"items": part, "next": part[-1]["id"] if begin + len(part) < len(captures) else None})
        elif path == "/v1/project":
            route.fulfill(json={"name": EVIL, "scope": "write"})
        elif path == "/v1/environments":
            route.fulfill(json={"items": [], "next": None})
        elif path == "/v1/jobs":
            route.fulfill(json={"jobs": [each for each in jobs if each["state"] in query["state"] and "kind" not in query], "next": None})
        else:
            route.fulfill(status=204)  # no events

    page.route("**/v1/**", answer)
    return submitted


@pytest.mark.long
def test_an_asset_is_found_by_the_name_of_its_capture(bare):
    """Its job has no name, and its card is far below; its request names the maps alone."""
    pretend(bare, [capture(number) for number in range(SHOWN + 20)])
    export = job(7, "succeeded", request={"kind": "export", "maps": job(3, "succeeded")["id"], "name": "", "format": "usdz"})
    export |= {"created_at": "2025-01-01T10:00:00Z"}
    bare.route("**/v1/jobs?limit=500&state=succeeded&kind=export&kind=pipeline",
               lambda route: route.fulfill(json={"jobs": [export], "next": None}))
    bare.route(f"**/v1/jobs/{job(3, 'succeeded')['id']}", lambda route: route.fulfill(json=job(3, "succeeded")))
    bare.goto("/")
    bare.get_by_label("Search by name").fill("bird 3")
    bare.locator(".card", has_text="Asset").locator("h3", has_text="bird 3").wait_for()


@pytest.mark.long
def test_a_thousand_captures_are_searched_sorted_and_filtered(bare):
    found = [capture(number) for number in range(CAPTURES)]
    found[7] = capture(7, steps=3) | {"name": EVIL}
    submitted = pretend(bare, found)
    bare.goto("/?words=bird+99")
    bare.get_by_text(f"{sum('99' in str(number) for number in range(CAPTURES))} of {CAPTURES}").wait_for()
    bare.locator("#strip li").first.wait_for()
    names = bare.locator("#wall h3")
    bare.get_by_label("Search by name").fill("")
    bare.get_by_text(f"{CAPTURES} in all").wait_for()
    bare.wait_for_url(re.compile("/$"))
    expect(names).to_have_count(SHOWN)
    bare.locator("#order").select_option("name")
    for at in range(3):
        expect(names.nth(1 + at)).to_have_text(f"bird {at}")  # numbers by value, and the other name before them
    bare.locator("#order").select_option("oldest")
    expect(names.first).to_have_text("bird 0")
    bare.locator(".chips label", has_text="Sequences").click()
    bare.get_by_text(f"1 of {CAPTURES}").wait_for()
    expect(names).to_have_text([EVIL])
    expect(bare.locator("#wall img, #wall script")).to_have_count(0)
    expect(bare).to_have_title("Home · Relit")
    expect(bare.get_by_text("3 time steps · 96 frames · 320 × 320")).to_be_visible()
    seen(bare, lambda: submitted, "no view is prepared")
    assert [each["kind"] for each in submitted] == ["view"]  # one view is prepared at a time
    bare.reload()
    bare.get_by_text(f"1 of {CAPTURES}").wait_for()
    expect(bare.get_by_label("Sequences")).to_be_checked()
    expect(bare.locator("#order")).to_have_value("oldest")


def test_jobs_say_why_they_wait_and_how_they_failed(bare):
    progress = {"stage": "normals", "done": 3, "total": 12, "rate": 1.0, "remaining_s": 9.0}
    pretend(bare, [capture(number) | {"view": None} for number in range(1, 4)], [
        job(1, "running", progress=progress), job(2, "queued"), job(3, "queued", priority=90), job(4, "queued", request={
            "kind": "depth", "capture": "cap_x", "name": EVIL}),
        job(5, "failed", error="bird: no frame can be read", finished_at="2100-01-01T00:00:00Z"),
        job(6, "failed", error="long ago", finished_at="2020-01-01T00:00:00Z")])
    bare.goto("/")
    strip = bare.locator("#strip")
    strip.get_by_text("normals 3 of 12, 9.0 s left").wait_for()
    expect(strip.get_by_text("behind Solve normals and materials · bird 1, which runs")).to_have_count(1)  # of the highest priority
    strip.get_by_text("behind 2 jobs, first Solve normals and materials · bird 1, which runs").wait_for()
    strip.get_by_text("behind 3 jobs, first Solve normals and materials · bird 1, which runs").wait_for()
    strip.get_by_text("bird: no frame can be read").wait_for()
    expect(strip.locator("li")).to_have_count(5)
    expect(strip.locator("img")).to_have_count(0)


def test_nothing_yet_says_what_to_do(bare):
    pretend(bare, [])
    bare.goto("/")
    bare.get_by_role("heading", name="Nothing here yet").wait_for()
    expect(bare.get_by_text("Choose a folder")).to_be_visible()
    expect(bare.locator(".skeleton:visible")).to_have_count(0)
    bare.get_by_text(f"Project {EVIL}").wait_for()


def test_the_sample_takes_one_click_after_which_the_keyboard_goes_on_at_its_card(bare):
    """Each card comes as it is made; the project's name, which never comes, holds nothing up."""
    tokens, held = [], []
    pretend(bare, [])
    bare.route("**/v1/project", lambda route: None)

    def make(route):
        tokens.append(route.request.headers["idempotency-key"])
        if "environments" in route.request.url:
            held.append(route)
        else:
            route.fulfill(status=201, json=capture(1) | {"name": "owl"})

    bare.route("**/v1/samples/**", make)
    bare.goto("/")
    bare.get_by_role("button", name="Open the sample owl").click()
    bare.locator(".card a", has_text="owl").wait_for()
    expect(bare.locator("#sample")).to_be_disabled()
    seen(bare, lambda: held, "the environment is not asked for")
    held[0].fulfill(status=201, json=capture(2) | {"id": f"env_{2:020d}", "name": "sky", "facts": {}})
    bare.locator(".card", has_text="sky").wait_for()
    bare.wait_for_function("() => document.activeElement.closest('.card') !== null && !document.getElementById('sample').disabled")
    assert len(set(tokens)) == len(tokens) == 2
    bare.get_by_role("button", name="Close", exact=True).click()
    expect(bare.locator("#drop")).to_be_hidden()
    expect(bare.locator("#add")).to_be_focused()
    with bare.expect_file_chooser():
        bare.get_by_role("button", name="Add a folder").click()
    expect(bare.locator("#drop")).to_be_visible()


@pytest.mark.long
def test_the_sample_is_opened_by_one_click_where_nothing_is_yet(browser, tmp_path):
    """A key of scope write suffices; the folder of the sample is none that this operator allows for others."""
    with serving(tmp_path / "empty", "--device", "cpu") as empty, opened_page(browser, base_url=empty.url) as page:
        page.add_init_script(f"sessionStorage.setItem('relit-key', '{empty.key(scope=Scope.WRITE)}')")
        page.goto("/")
        page.get_by_role("button", name="Open the sample owl").click()
        page.locator(".card", has_text="owl").locator("canvas").wait_for()  # it was checked, and has a view
        page.get_by_text("Project larch").wait_for()
        seen(page, lambda: sorted(page.locator("#wall h3").all_inner_texts()) == ["environment.exr", "owl"])
        page.locator(".card a", has_text="owl").click()
        page.locator("canvas.picture[data-ready]").wait_for()


@pytest.mark.long
def test_what_is_loading_is_seen_at_once(page):
    page.route("**/v1/**", lambda route: None)  # no answer
    page.goto("/", wait_until="commit")
    page.locator(".card.skeleton").first.wait_for()
    page.goto("/jobs", wait_until="commit")
    page.locator("main .skeleton").first.wait_for()


def await_picture(page, identifier: str) -> None:
    """Wait for the picture of a card, which is loaded when the card is in sight; the wall may make cards anew meanwhile."""
    page.wait_for_function("""(identifier) => {
      const card = document.querySelector(`[data-id=${identifier}]`);
      card?.scrollIntoView();
      return card?.querySelector("canvas") ?? null;
    }""", arg=identifier)


@pytest.mark.long
def test_the_wall_shows_pictures_whose_light_follows_the_pointer(page, solved, sky):
    page.goto("/")
    card = page.locator(f"[data-id={solved.capture}]")
    await_picture(page, solved.capture)
    light = "canvas => [...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data].filter((_, at) => at % 4 === 0)"
    sums, pictures = {}, [card.locator("canvas").evaluate(light)]

    def lit_from(x: float) -> list[int] | None:
        """The picture under the pointer, when it is another one than before; the wall may move, and make the card anew, meanwhile."""
        box = card.locator(".shown").bounding_box()
        if box is None:
            return None
        page.mouse.move(box["x"] + x * box["width"], box["y"] + 0.4 * box["height"])
        page.mouse.move(box["x"] + x * box["width"], box["y"] + 0.5 * box["height"])
        red = card.locator("canvas").evaluate(light)
        return None if red in pictures else red

    for side, x in {"left": 0.1, "right": 0.9}.items():
        red = seen(page, lambda x=x: lit_from(x))
        pictures.append(red)
        width = round(len(red) ** 0.5)
        sums[side] = [sum(value for at, value in enumerate(red) if (at % width < width / 2) == left) for left in (True, False)]
    assert sums["left"][0] > sums["right"][0] and sums["left"][1] < sums["right"][1]
    await_picture(page, sky)
    card.get_by_role("link").press("Enter")
    page.wait_for_url(re.compile(f"/{solved.capture}(#|$)"))


@pytest.mark.long
def test_the_wall_is_used_by_the_keyboard_alone(page, solved):
    page.goto("/")
    page.locator(f"[data-id={solved.capture}] h3").wait_for()
    await_whole(page)
    page.keyboard.press("Tab")
    expect(page.locator(".skip")).to_be_focused()
    page.get_by_label("Search by name").focus()
    page.keyboard.type("lambert")
    for key in ("Tab", "ArrowRight"):  # the kinds are one stop, and arrow keys choose
        page.keyboard.press(key)
    expect(page.get_by_label("Captures", exact=True)).to_be_checked()
    page.wait_for_function("() => new URLSearchParams(location.search).get('kind') === 'capture'")


@pytest.mark.long
def test_light_and_dark_are_chosen_and_kept(browser, server):
    paper = "() => getComputedStyle(document.body).backgroundColor"
    with opened_page(browser, base_url=server.url, color_scheme="light") as page:
        page.goto("/jobs")
        light = page.evaluate(paper)
        page.get_by_role("button", name="Show in dark").click()
        dark = seen(page, lambda: (now := page.evaluate(paper)) != light and now)
        page.goto("/captures")
        page.wait_for_function(f"(dark) => ({paper})() === dark", arg=dark)
        page.get_by_role("button", name="Show in light").click()
        page.wait_for_function(f"(light) => ({paper})() === light", arg=light)

