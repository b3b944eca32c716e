"""Jobs are submitted by forms, followed, cancelled and continued; a lost connection is said and regained."""

import json
import math
import re
import shlex
import subprocess
import sys
from urllib.parse import urlsplit

import numpy as np
import pytest

from service.client import Client
from service.server.pages.forms import BEGIN_WITH, NEXT_STEPS, TITLES
from tests.scenes.captures import write_exr
from tests.service.server.api.job_calls import admitted
from tests.service.server.pages.conftest import SAMPLES, await_whole, expect, new_context, seen
from tests.service.server.tcp_proxy import tcp_proxy

pytestmark = pytest.mark.long

JOB_MS = 120_000
"""Time for a small job on a loaded machine."""


@pytest.fixture(scope="session")
def capture(server, client) -> str:
    """A small capture, registered and ready."""
    return admitted(server, client, SAMPLES / "lambert")["id"]


@pytest.fixture(scope="module")
def patterns(server, tmp_path_factory) -> str:
    """A capture of projected patterns, uploaded and ready."""
    folder = tmp_path_factory.mktemp("patterns") / "<b>stripes"
    folder.mkdir()
    images = [f"{index}.exr" for index in range(2)]
    for image in images:
        write_exr(folder / image, np.ones((8, 8, 3)))
    frames = [{"image": image, "pattern": {"code": code}} for image, code in zip(images, ("black", "white"), strict=True)]
    (folder / "capture.json").write_text(json.dumps({"schema": "relit.capture/1", "name": "<b>stripes", "frames": frames, "camera": {
        "projection": "orthographic", "resolution": [8, 8], "pixel_size_m": 0.001}}))
    with Client(server.url) as client:
        return client.captures.upload(folder).id


def await_offers(page, kinds: set[str]) -> None:
    """Open all that a capture's page offers, and wait until it is these kinds of jobs."""
    page.locator("#more > summary").click()
    page.wait_for_function("""(kinds) => {
      const forms = [...document.querySelectorAll("form[data-kind]")].filter((each) => each.parentElement.checkVisibility());
      return JSON.stringify(forms.map((each) => each.dataset.kind).sort()) === JSON.stringify(kinds);
    }""", arg=sorted(kinds))


def test_jobs_are_chosen_by_what_asks_for_them_and_how_they_are(page, solved):
    page.goto("/jobs")
    page.locator("#jobs tbody a", has_text="Check").first.wait_for()
    page.get_by_text("Without checks and views").click()
    page.wait_for_function("() => !/Check|View/.test(document.querySelector('#jobs tbody').textContent)")
    expect(page.locator("#jobs tbody a", has_text=TITLES["solve"]).first).to_be_visible()
    page.get_by_text("Failed", exact=True).click()
    page.wait_for_function("() => location.hash === '#failed'")
    page.reload()
    await_whole(page)
    expect(page.get_by_role("radio", name="Failed")).to_be_checked()
    expect(page.locator("#jobs .state:not(.failed)")).to_have_count(0)


def test_a_capture_leads_with_what_it_is_made_for_and_offers_nothing_that_cannot_apply(client, page, capture, patterns):
    page.goto(f"/captures/{patterns}")
    page.get_by_role("heading", name="<b>stripes", level=1).wait_for()
    await_offers(page, {kind for kind, what in BEGIN_WITH.items() if "pattern" in what})
    expect(page.locator("#next > button[data-kind]:visible")).to_have_text([TITLES[kind] for kind in NEXT_STEPS["pattern"]])
    page.goto(f"/captures/{capture}")
    page.get_by_role("link", name="Light it").wait_for()
    await_offers(page, {kind for kind, what in BEGIN_WITH.items() if "light" in what})
    expect(page.locator("#next :is(.button, button):not(.quiet):visible")).to_have_count(1)  # one that stands out
    page.get_by_role("button", name=TITLES["pipeline"]).click()
    page.wait_for_url("**/object/cap_*")
    jobs = client.get("/v1/jobs", params={"kind": "pipeline", "limit": 500}).json()["jobs"]
    job, = [each["id"] for each in jobs if each["request"]["capture"] == capture]
    page.goto(f"/jobs/{job}")  # on the page of the object its line goes when it has succeeded
    expect(page.locator(f"#request dd a[href='/captures/{capture}']")).to_be_visible()
    page.locator("#usual-part > summary").click()
    expect(page.locator("#usual dt").first).to_be_visible()
    request = page.locator("#request, #usual").all_inner_texts()
    assert "[object" not in "".join(request) and "{" not in "".join(request)
    names = page.locator("#request dt, #usual dt").all_inner_texts()
    assert len(names) == len(set(names)) and {"Capture", "Clip negative", "Textures"} <= set(names)
    client.post(f"/v1/jobs/{job}/cancel")


def test_a_deletion_is_undone_and_done(server, client, page):
    """Time is the page's own clock, which the test stops and moves."""
    capture = admitted(server, client, SAMPLES / "lambert")["id"]
    page.clock.install()
    page.goto(f"/captures/{capture}")
    page.locator("#frames canvas").first.wait_for(timeout=JOB_MS)  # a capture that a job still reads is not deleted
    await_whole(page)
    page.clock.pause_at(page.evaluate("Date.now()") + 30_000)  # later than now, however slow the machine is
    for _ in range(2):
        page.get_by_role("button", name="Delete").click()
        page.get_by_role("alert").get_by_text("lambert is deleted in 8 s.").wait_for()
        page.get_by_role("button", name="Undo").click()
        page.clock.run_for(20_000)
    assert client.get(f"/v1/captures/{capture}").status_code == 200
    page.get_by_role("button", name="Delete").click()
    page.clock.run_for(9_000)
    page.wait_for_url("**/captures")
    assert client.get(f"/v1/captures/{capture}").status_code == 404


def opened_form(page, title: str, options: bool = True):
    """Open the form of a job, its options and what shows it as a command."""
    page.locator("#work:not([hidden])").wait_for()
    await_whole(page)
    summary = page.locator("summary", has_text=title).first
    if not summary.is_visible():
        page.locator("#more > summary").click()
    summary.click()
    form = page.locator(".job-form[open] form")
    if options:
        form.locator("> details:not(.same-as) > summary").click()
    form.locator(".same-as > summary").click()
    return form


def submitted(page) -> str:
    page.locator(".job-form[open] button[type=submit]").click()
    page.wait_for_url("**/jobs/job_*")
    return page.url.rpartition("/")[2]


def slow_job(client, capture: str, sky: str) -> str:
    """A job of many frames, which lasts until it is cancelled."""
    return client.post("/v1/jobs", json={"kind": "relight", "capture": capture, "environment": sky, "options": {
        "frames": "1-300", "spin_degrees": 360}}).raise_for_status().json()["id"]


def test_a_form_submits_a_job_that_is_followed_to_its_results(client, page, capture):
    page.goto(f"/captures/{capture}")
    form = opened_form(page, "Solve normals")
    form.get_by_label("Method").select_option("lambert")
    form.get_by_label("Priority").fill("60")
    job = submitted(page)
    page.locator(".state.succeeded").wait_for(timeout=JOB_MS)
    page.locator("#results").get_by_text("maps.exr").wait_for()
    found = client.get(f"/v1/jobs/{job}").json()
    assert (found["request"]["options"]["method"], found["priority"]) == ("lambert", 60)
    report = client.get(f"/v1/jobs/{job}/results/report.json").json()
    expect(page.locator("#stages tbody td:first-child")).to_have_text(list(report["timings_s"]))
    page.locator("summary", has_text="Log").click()
    page.locator("#log li", has_text="attempt 1: succeeded").wait_for()
    with page.expect_download() as download:
        page.locator("#results").get_by_text("report.json").click()
    assert json.loads(download.value.path().read_text()) == report


def test_patterns_are_drawn_from_the_page_of_jobs(page):
    """A job that reads nothing; its periods are typed as in a command."""
    page.goto("/jobs")
    form = opened_form(page, "Draw patterns to project")
    form.get_by_label("Code").select_option("phase")
    form.get_by_label("Projector").fill("64x32")
    form.get_by_label("Periods", exact=True).fill("16,18")
    expect(form.locator("[data-shows=command]")).to_have_text(re.compile(r" patterns phase .*--projector 64x32 --periods 16,18$"))
    submitted(page)
    page.locator(".state.succeeded").wait_for(timeout=JOB_MS)
    page.locator("#results").get_by_text("patterns.json").wait_for()


def test_forms_of_several_captures_and_images(page, capture, patterns):
    page.goto(f"/captures/{patterns}")
    form = opened_form(page, "Calibrate camera and projector", options=False)
    form.get_by_label("Board").fill("9x6")
    form.get_by_label("Square (metres)").fill("0.03")
    command = form.locator("[data-shows=command]")  # the page's capture is entered
    expect(command).to_have_text(re.compile(rf"calibrate-procam {patterns} .*--board 9x6 --square-m 0\.03$"))
    page.goto(f"/captures/{capture}")
    form = opened_form(page, "Calibrate the dark frame", options=False)
    form.get_by_label("Images").fill("b.exr\na.exr")
    expect(command).to_contain_text(f"calibrate-dark {capture} b.exr a.exr")
    form.get_by_label("Images").fill("")
    form.locator("button[type=submit]").click()
    form.locator(".fault", has_text="Images: ").wait_for()


def test_a_form_can_be_sent_before_its_lists_have_come_and_what_is_chosen_meanwhile_stays(page, capture):
    """The page's capture is in the form at once; another one that is chosen while the list still comes is not put back."""
    first, second = ({"id": f"cap_{each * 20}", "name": each, "state": "ready"} for each in "ab")
    held = []

    def listed(route):
        if "before=" in route.request.url:
            held.append(route)
        else:
            route.fulfill(json={"items": [first], "next": first["id"]})

    page.route(re.compile(r"/v1/captures(\?|$)"), listed)
    page.goto(f"/captures/{capture}")
    form = opened_form(page, "Solve normals", options=False)
    command, chosen = form.locator("[data-shows=command]"), form.get_by_label("Capture", exact=True)
    expect(command).to_contain_text(f" solve {capture}")
    chosen.select_option(first["id"])
    expect(command).to_contain_text(f" solve {first['id']}")
    seen(page, lambda: held, "the second part of the list is not asked for")
    held[0].fulfill(json={"items": [second], "next": None})
    expect(chosen.locator("option")).to_have_count(4)  # none, the page's and both of the list
    expect(chosen).to_have_value(first["id"])
    expect(command).to_contain_text(f" solve {first['id']}")


def test_what_a_form_sends_is_shown_as_a_command_and_as_curl(client, page, capture, sky):
    """Both are run as they are shown, and make the same request as the form."""
    page.goto(f"/captures/{capture}")
    form = opened_form(page, "Relight frames")
    form.get_by_label("Environment").select_option(sky)
    form.get_by_label("Frames", exact=True).fill("1-2")
    form.get_by_label("Exposure").fill("-1.5")
    form.get_by_label("Name").fill("it's a test")
    form.get_by_label("Align", exact=True).uncheck()
    command, curl = (form.locator(f"[data-shows={name}]") for name in ("command", "curl"))
    expect(curl).to_contain_text("s a test")
    command, curl = command.inner_text(), curl.inner_text()  # both are written at once
    job = submitted(page)
    done = subprocess.run([sys.executable, "-m", "service.cli.main", *shlex.split(command)[1:]], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    by_command = re.search(r"job_\w+", done.stdout)[0]
    by_curl = json.loads(subprocess.run(shlex.split(curl), capture_output=True, text=True, timeout=60, check=True).stdout)["id"]
    requests = [client.get(f"/v1/jobs/{each}").json()["request"] for each in (job, by_command, by_curl)]
    assert requests[0] == requests[1] == requests[2]
    assert requests[0]["options"]["exposure"] == -1.5 and requests[0]["name"] == "it's a test"


def test_a_value_that_cannot_be_is_named_and_a_failed_job_is_tried_again(page, capture):
    page.goto(f"/captures/{capture}")
    form = opened_form(page, "Solve normals")
    form.get_by_label("Least confidence").fill("2")
    form.get_by_role("button", name="Submit").click()
    form.get_by_text("Least confidence: is 2: give 0 to 1").first.wait_for()
    form.get_by_label("Least confidence").fill("")
    form.get_by_label("Align to").fill("nothing.png")
    form.get_by_role("button", name="Submit").click()
    page.wait_for_url("**/jobs/job_*")
    expect(page.locator("#error")).to_have_text(re.compile(r"\S"), timeout=JOB_MS)  # the service says what it is that it does not find
    page.get_by_role("button", name="Retry").click()
    page.locator("#state").get_by_text("attempt 2").wait_for(timeout=JOB_MS)


def test_a_job_is_cancelled_and_resumed(server, client, page, capture, sky):
    job = slow_job(client, capture, sky)
    page.goto(f"/jobs/{job}")
    page.locator("#stage").get_by_text("frames").wait_for(timeout=JOB_MS)
    page.get_by_role("button", name="Cancel").click()
    page.locator(".state.cancelled").wait_for()
    page.get_by_role("button", name="Resume").click()
    page.locator("#state").get_by_text("attempt 2").wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.locator(".state.cancelled").wait_for()
    server.wait(client, f"/v1/jobs/{job}", ("cancelled",))
    page.clock.install()
    page.get_by_role("button", name="Delete").click()
    page.clock.run_for(9_000)  # in which it can be undone
    page.wait_for_url("**/jobs")
    assert client.get(f"/v1/jobs/{job}").status_code == 404


def test_a_lost_connection_is_said_and_regained(server, client, browser, capture, sky):
    """The connections of the page are cut, and new ones refused for a while; the job ends meanwhile."""
    with tcp_proxy(urlsplit(server.url).port) as way:
        job = slow_job(client, capture, sky)
        page = new_context(browser, base_url=way.url).new_page()
        page.goto(f"/jobs/{job}")
        page.locator("#stage").get_by_text("frames").wait_for(timeout=JOB_MS)
        way.cut(away_s=math.inf)
        page.get_by_role("status").filter(has_text="The connection is lost").wait_for(timeout=JOB_MS)
        client.post(f"/v1/jobs/{job}/cancel")
        way.mend()
        page.locator(".state.cancelled").wait_for(timeout=JOB_MS)
        expect(page.locator("#connection")).to_be_hidden()
        page.close()


def test_the_list_follows_all_jobs(client, page, capture):
    page.goto("/jobs")
    request = {"kind": "solve", "capture": capture, "name": "seen", "options": {"method": "lambert"}}
    job = client.post("/v1/jobs", json=request).raise_for_status().json()["id"]
    row = page.locator("#jobs tr", has_text=job)
    row.locator(".state.succeeded").wait_for(timeout=JOB_MS)
    client.delete(f"/v1/jobs/{job}").raise_for_status()
    row.wait_for(state="detached")
