"""A folder without a capture.json is dropped on the page, and is a capture after one more click."""

import shutil

import pytest

from tests.scenes.foreign import write_four_phases
from tests.service.server.pages.conftest import await_whole, expect
from tests.service.server.pages.photographs import write_photographs

pytestmark = pytest.mark.long

UPLOAD_MS = 60_000
"""Time for an upload of some megabytes and the looks at it; it takes two seconds on a machine that does nothing else."""


@pytest.fixture
def photographs(tmp_path):
    return write_photographs(tmp_path / tmp_path.name)


def captures_named(client, name: str) -> list[dict]:
    return [item for item in client.get("/v1/captures", params={"limit": 500}).json()["items"] if item["name"] == name]


def test_photographs_are_a_capture_after_two_clicks_and_dropped_twice_they_are_one(client, page, photographs):
    count = len(list(photographs.glob("*.png")))
    page.goto("/captures")
    page.set_input_files("#folder", photographs)
    page.get_by_text(f"{count} photographs lit from {count} directions (light_directions.txt)").first.wait_for(timeout=UPLOAD_MS)
    page.get_by_text("1 file of 1.0 MB that no import needs stays on this machine").wait_for()
    page.get_by_role("button", name="Import", exact=True).click()
    page.wait_for_url("**/object/cap_*", timeout=UPLOAD_MS)
    page.get_by_role("heading", name=photographs.name, level=1).wait_for()
    sent = []
    page.on("request", lambda request: sent.append(request.url) if request.method == "PATCH" else None)
    page.goto("/captures")
    page.set_input_files("#folder", photographs)
    page.get_by_role("link", name="Look at it").wait_for(timeout=UPLOAD_MS)
    found, = captures_named(client, photographs.name)
    assert (found["state"], found["facts"]["frames"], sent) == ("ready", count, [])


def test_another_folder_of_the_same_name_is_another_capture(client, page, photographs):
    page.goto("/captures")
    page.set_input_files("#folder", photographs)
    page.get_by_role("button", name="Import", exact=True).click(timeout=UPLOAD_MS)
    page.wait_for_url("**/object/cap_*", timeout=UPLOAD_MS)
    path = photographs / "light_directions.txt"
    path.write_text(path.read_text().replace("0.9", "0.8"))  # as long as before
    page.goto("/captures")
    page.set_input_files("#folder", photographs)
    page.get_by_role("button", name="Import", exact=True).wait_for(timeout=UPLOAD_MS)
    assert sorted(item["state"] for item in captures_named(client, photographs.name)) == ["ready", "receiving"]


def test_what_files_do_not_say_is_asked_for(client, page, tmp_path):
    folder = write_four_phases(tmp_path / tmp_path.name)
    page.goto("/captures")
    page.set_input_files("#folder", folder)
    field = page.get_by_label("Frequencies (Hz)")
    field.wait_for(timeout=UPLOAD_MS)
    page.get_by_role("button", name="Import", exact=True).click()
    page.get_by_text("Frequencies (Hz): choose one").wait_for()
    page.reload()  # what was looked at can be imported later
    page.get_by_role("row", name=folder.name).get_by_role("button", name="Choose and import").click()
    field.fill("60e6")
    page.get_by_role("button", name="Import", exact=True).click()
    page.wait_for_url("**/object/cap_*", timeout=UPLOAD_MS)
    assert [item["state"] for item in captures_named(client, folder.name)] == ["ready"]


def test_names_that_are_markup_are_text(page, photographs):
    """The names of the folder and of its table are shown; the names of images are not used where they cannot be stored."""
    folder = photographs.with_name("<img src=x onerror=alert(1)>")
    shutil.move(photographs, folder)
    (folder / "light_directions.txt").rename(folder / "<img src=y onerror=alert(2)>.txt")
    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    page.goto("/captures")
    page.set_input_files("#folder", folder)
    page.get_by_text('"<img src=y onerror=alert(2)>.txt": has <').wait_for(timeout=UPLOAD_MS)
    (folder / "<img src=y onerror=alert(2)>.txt").rename(folder / "&lt;img src=y onerror=alert(2)&gt;.txt")
    page.set_input_files("#folder", folder)
    page.get_by_text("(&lt;img src=y onerror=alert(2)&gt;.txt)").first.wait_for(timeout=UPLOAD_MS)
    expect(page.locator("main img")).to_have_count(0)


def test_a_lost_server_is_told_and_waited_for(client, page, photographs):
    lost = []
    page.route("**/v1/captures/*/files", lambda route: (lost.append(1), route.abort("connectionreset")) if len(lost) < 3 and
               route.request.method == "POST" else route.continue_())
    def lose_the_answer(route):
        """The server is asked, and the page does not learn what it says."""
        page.unroute("**/v1/captures/*/guess")
        route.fetch()
        route.abort("connectionreset")

    page.route("**/v1/captures/*/guess", lose_the_answer)
    page.goto("/")
    await_whole(page)
    page.set_input_files("#folder", photographs)
    page.get_by_text("The server cannot be reached. The upload waits").wait_for(timeout=UPLOAD_MS)
    page.locator("#close").dispatch_event("click")  # what is under way stays in sight
    page.get_by_role("button", name="Import", exact=True).wait_for(timeout=UPLOAD_MS)
    assert len(captures_named(client, photographs.name)) == 1
