"""A stranger has a folder of photographs, and wants a relit picture and an asset of them: every press of the pointer is counted."""

import pytest

from tests.service.server.pages.axe import assert_accessible
from tests.service.server.pages.conftest import await_whole, expect, new_context
from tests.service.server.pages.frames import picture
from tests.service.server.pages.photographs import write_photographs

pytestmark = pytest.mark.long

WORK_MS = 120_000
COUNT = """addEventListener("pointerdown", ({ isTrusted }) => {
  if (isTrusted) sessionStorage.presses = 1 + Number(sessionStorage.presses ?? 0);
}, true);"""
"""Counts over all pages of the tab."""
SEE_PROGRESS = """() => {
  const work = document.getElementById("work");
  globalThis.wasFollowed = false;
  new MutationObserver(() => { wasFollowed ||= work.querySelector("progress") !== null; }).observe(work, { childList: true });
}"""
"""Notes whether the progress of a job was shown, which may be over before a test can look."""


@pytest.fixture
def counting(browser, server):
    context = new_context(browser, base_url=server.url, viewport={"width": 1280, "height": 900}, bypass_csp=True)
    context.add_init_script(COUNT)
    yield context.new_page()
    context.close()


def presses(page) -> int:
    return int(page.evaluate("sessionStorage.presses"))


def saved_asset(page) -> bytes:
    """Make the asset on the page of the object, which is not left meanwhile, and save it."""
    address = page.url.partition("#")[0]
    page.evaluate(SEE_PROGRESS)
    page.get_by_role("button", name="Make an asset").click()
    link = page.get_by_role("link", name="Save asset.usdz")
    link.wait_for(timeout=WORK_MS)
    assert page.evaluate("wasFollowed")
    assert page.url.partition("#")[0] == address
    with page.expect_download() as download:
        link.click()
    return download.value.path().read_bytes()


def opened(page) -> None:
    """Open the home page, and wait until it takes folders."""
    page.goto("/")
    page.locator("#bar").wait_for()
    await_whole(page)


def drop(page, folder) -> None:
    """Drop a folder of this machine on the page, as a browser does it."""
    client = page.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        client.send("Input.dispatchDragEvent", {"type": kind, "x": 600, "y": 500, "data": {
            "items": [], "files": [str(folder)], "dragOperationsMask": 1}})


def test_a_dropped_folder_becomes_a_picture_and_an_asset_in_three_clicks(counting, tmp_path):
    page = counting
    opened(page)
    drop(page, write_photographs(tmp_path / tmp_path.name))
    page.locator(".proposal strong", has_text="32 photographs lit from 32 directions (light_directions.txt)").wait_for(timeout=WORK_MS)
    page.get_by_role("button", name="Import", exact=True).click()
    page.locator("canvas.picture[data-ready]").wait_for(timeout=WORK_MS)
    assert picture(page).std() > 0.05  # an object before the even grey
    expect(page.locator("textarea:visible")).to_have_count(0)
    assert saved_asset(page)[:2] == b"PK"
    assert presses(page) == 3
    expect(page.locator("#modes button")).to_have_text(["Light", "Maps", "3-D", "Photographs"])
    page.locator("#report-part > summary").click()
    page.get_by_text("Time taken", exact=True).wait_for()
    words = page.locator("#report-part > div").inner_text()
    assert "{" not in words and "[object" not in words


def tab_to(page, name: str) -> None:
    """Go from control to control by the key Tab, until one has this name."""
    for _ in range(120):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.textContent.trim()") == name:
            return
    pytest.fail(f"Tab does not lead to {name}")


def test_the_keyboard_alone_leads_from_a_folder_to_an_asset(counting, tmp_path):
    page, folder = counting, write_photographs(tmp_path / tmp_path.name)
    opened(page)
    with page.expect_file_chooser() as chooser:  # begun before the keys, which do not wait for its beginning
        tab_to(page, "Add a folder")
        page.keyboard.press("Enter")
    chooser.value.set_files(folder)
    page.locator(".proposal button").wait_for(timeout=WORK_MS)
    tab_to(page, "Import")
    assert_accessible(page)  # with the open proposal
    page.keyboard.press("Enter")
    page.locator("canvas.picture[data-ready]").wait_for(timeout=WORK_MS)
    await_whole(page)
    tab_to(page, "Make an asset")
    page.keyboard.press("Enter")
    page.get_by_role("link", name="Save asset.usdz").wait_for(timeout=WORK_MS)
    page.locator(".skip").focus()
    tab_to(page, "Save asset.usdz")
    with page.expect_download():
        page.keyboard.press("Enter")
    assert page.evaluate("sessionStorage.presses") is None


def test_lights_that_nobody_has_measured_are_found_and_the_page_says_so(counting, client, tmp_path):
    """The folder is chosen, which takes a click more than to drop it."""
    page, folder = counting, write_photographs(tmp_path / tmp_path.name, table=False)
    opened(page)
    with page.expect_file_chooser() as chooser:
        page.get_by_role("button", name="Add a folder").click()
    chooser.value.set_files(folder)
    page.get_by_text("Lights unknown: they are taken for distant ones").wait_for(timeout=WORK_MS)
    page.get_by_role("button", name="Import", exact=True).click()
    page.wait_for_url("**/object/cap_*", timeout=WORK_MS)
    page.locator("#next .granted", has_text="Nobody has measured").wait_for(timeout=WORK_MS)
    expect(page.locator("#modes button")).to_have_text(["Photographs"])  # under lights that nobody knows nothing is relit
    assert saved_asset(page)[:2] == b"PK"
    assert presses(page) == 4
    expect(page.locator("#modes button")).to_have_text(["Light", "Maps", "3-D", "Photographs"])
    page.get_by_role("button", name="Light", exact=True).click()
    page.locator("canvas.picture[data-ready]").wait_for(timeout=WORK_MS)
    assert picture(page).std() > 0.05
    page.get_by_text("those that the solve has found").wait_for()
    capture = page.url.partition("#")[0].rpartition("/")[2]
    made = [job for job in client.get("/v1/jobs", params={"limit": 50}).json()["jobs"]
            if job["request"].get("capture") == capture and job["request"]["kind"] == "pipeline"]
    report = client.get(f"/v1/jobs/{made[0]['id']}/results/report.json").json()
    assert made[0]["request"]["solve"]["lights"] == "unknown" and len(report["found"]["unknown_lights"]["directions"]) == 32
    page.goto(f"/captures/{capture}")
    page.locator("#work:not([hidden])").wait_for()
    expect(page.locator("form[data-kind=solve] [data-name=lights] select")).to_have_value("unknown")
    expect(page.locator("#calibrations [data-calibration=lights].missing")).to_have_count(1)
