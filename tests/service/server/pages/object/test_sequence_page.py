"""A sequence on the pages: the time step that is shown is chosen on the page of its maps, and on that of its capture."""

import re

import pytest

from tests.scenes.sequence import write_sequence
from tests.service.server.api.test_measuring import files_of, upload
from tests.service.server.pages.axe import assert_accessible
from tests.service.server.pages.conftest import CONTENT_MS, await_whole, done, expect

pytestmark = pytest.mark.long

STEPS = 3


@pytest.fixture(scope="module")
def walk(server, client, tmp_path_factory) -> tuple[str, str]:
    """The capture of a sequence, and the job that solved it."""
    folder = tmp_path_factory.mktemp("walk")
    write_sequence(folder, [None] * STEPS, noise=0.01, size=16)
    capture = upload(server, client, files_of(folder))["id"]
    return capture, done(server, client, {"kind": "solve", "capture": capture, "options": {"method": "lambert"}})


def test_the_maps_and_the_frames_of_each_step_are_looked_at(page, walk):
    page.goto(f"/jobs/{walk[1]}")
    page.get_by_role("link", name="Look at the maps").click()
    page.get_by_role("heading", name="Maps of step00", level=1).wait_for(timeout=CONTENT_MS)
    steps = [f"step{step:02d} ({step + 1} of {STEPS})" for step in range(STEPS)]
    expect(page.get_by_label("Time step").locator("option")).to_have_text(steps)
    expect(page.get_by_role("button", name="Step before")).to_be_disabled()
    page.get_by_label("Time step").select_option("2")
    page.get_by_role("heading", name="Maps of step01", level=1).wait_for(timeout=CONTENT_MS)
    page.wait_for_url(re.compile(r"\?step=2(#|$)"))
    page.get_by_role("button", name="Step after").click()
    page.get_by_role("heading", name="Maps of step02", level=1).wait_for(timeout=CONTENT_MS)
    page.locator("canvas.map").first.wait_for(timeout=CONTENT_MS)
    expect(page.get_by_role("button", name="Step after")).to_be_disabled()
    page.goto(f"/captures/{walk[0]}?step=2")
    page.locator("#frames canvas").first.wait_for(timeout=CONTENT_MS)
    await_whole(page)
    expect(page.get_by_label("Time step")).to_have_value("2")
    expect(page.get_by_role("link", name="Light it")).to_be_hidden()
    page.goto(f"/jobs/{walk[1]}")
    page.locator("#results a").first.wait_for(timeout=CONTENT_MS)
    await_whole(page)
    expect(page.get_by_role("link", name="Light the capture")).to_be_hidden()
    page.get_by_text("Export an asset").wait_for(timeout=CONTENT_MS)


def test_the_choice_of_a_step_has_no_violation(open_to_axe, walk):
    open_to_axe.goto(f"/jobs/{walk[1]}")
    open_to_axe.get_by_role("link", name="Look at the maps").click()
    open_to_axe.locator("canvas.map").first.wait_for(timeout=CONTENT_MS)
    await_whole(open_to_axe)
    assert_accessible(open_to_axe)
