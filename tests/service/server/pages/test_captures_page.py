"""Captures are uploaded by the page: whole, continued, stopped, and refused with a sentence."""

import hashlib
import json
import shutil

import pytest

from tests.service.server.pages.conftest import CONTENT_MS, SAMPLES, await_whole, expect

pytestmark = pytest.mark.long

UPLOAD_MS = 60_000
"""Time for an upload of two megabytes and its check; it takes a second on a machine that does nothing else."""


@pytest.fixture
def folder(tmp_path):
    """A copy of a small sample, whose name no other test uses."""
    return shutil.copytree(SAMPLES / "lambert", tmp_path / tmp_path.name, ignore=shutil.ignore_patterns(".*"))


def stored(client, name: str) -> dict:
    """The newest capture of this name, with its files."""
    found = next(item for item in client.get("/v1/captures").json()["items"] if item["name"] == name)
    return found | {"files": client.get(f"/v1/captures/{found['id']}/files").json()["files"]}


def test_a_folder_is_uploaded_whole_but_for_hidden_files(client, page, folder):
    local = {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}
    (folder / ".relit").mkdir(exist_ok=True)
    (folder / ".relit" / "cache").write_bytes(b"0")
    (folder / ".DS_Store").write_bytes(b"0")
    page.goto("/captures")
    page.set_input_files("#folder", folder)
    page.get_by_role("link", name="Look at it").click(timeout=UPLOAD_MS)
    page.get_by_role("heading", name=folder.name, level=1).wait_for()
    found = stored(client, folder.name)
    assert found["state"] == "ready"
    assert {file["path"]: file["sha256"] for file in found["files"]} == local
    page.locator("#facts").get_by_text("Identifier", exact=True).wait_for()
    expect(page.locator("#facts")).to_contain_text("128 × 128")


def test_an_upload_goes_on_after_broken_requests(client, page, folder):
    """Every third request that carries bytes is cut, as by a bad network."""
    seen = []

    def cut(route):
        seen.append(route.request.method)
        if route.request.method == "PATCH" and seen.count("PATCH") % 3 == 1:
            route.abort("connectionreset")
        else:
            route.continue_()

    page.route("**/v1/uploads/*", cut)
    page.goto("/captures")
    page.set_input_files("#folder", folder)
    page.get_by_role("link", name="Look at it").wait_for(timeout=2 * UPLOAD_MS)
    assert stored(client, folder.name)["state"] == "ready"


def test_a_stopped_upload_is_continued_with_what_is_missing(client, page, folder):
    begun = []
    page.on("request", lambda request: begun.append(request.url) if request.method == "POST" and request.url.endswith("/files") else None)
    page.route("**/v1/uploads/*", lambda route: route.abort("connectionreset") if len(begun) > 8 else route.continue_())
    page.goto("/captures")
    page.set_input_files("#folder", folder)
    page.wait_for_function("() => document.querySelector('#uploads progress')?.value > 0")
    page.get_by_role("button", name="Stop").click()
    page.get_by_text("Drop the same folder again to continue").wait_for()
    before = {file["path"] for file in stored(client, folder.name)["files"] if file["done"]}
    assert 0 < len(before) < len(list(folder.iterdir()))
    page.unroute("**/v1/uploads/*")
    begun.clear()
    page.set_input_files("#folder", folder)
    page.get_by_role("link", name="Look at it").wait_for(timeout=UPLOAD_MS)
    found = stored(client, folder.name)
    assert found["state"] == "ready"
    assert len(begun) <= len(found["files"]) - len(before)
    assert [item["name"] for item in client.get("/v1/captures").json()["items"]].count(folder.name) == 1


def test_a_manifest_that_is_broken_is_named(page, folder):
    manifest = json.loads((folder / "capture.json").read_text())
    manifest["frames"][3]["light"]["direction"] = [0, 0]
    (folder / "capture.json").write_text(json.dumps(manifest))
    page.goto("/captures")
    page.set_input_files("#folder", folder)
    for words in ("frames", "direction"):
        expect(page.locator("#uploads .fault")).to_contain_text(words, timeout=UPLOAD_MS)


def test_an_environment_is_uploaded(client, page, tmp_path):
    file = shutil.copy(SAMPLES / "owl" / "environment.exr", tmp_path / "a sky of its own.exr")
    page.goto("/captures")
    page.set_input_files("#file", file)
    page.locator("#environments tr", has_text="a sky of its own").locator(".state.ready").wait_for(timeout=UPLOAD_MS)
    [found] = [each for each in client.get("/v1/environments").json()["items"] if each["name"].startswith("a sky of its own")]
    assert found["state"] == "ready"


def test_a_folder_without_images_is_refused_and_its_name_is_text(page, tmp_path):
    """A folder whose name is markup is shown as its name."""
    folder = tmp_path / "<img src=x onerror=alert(1)>"
    folder.mkdir()
    (folder / "a.txt").write_text("nothing")
    page.goto("/captures")
    page.set_input_files("#folder", folder)
    page.get_by_text("<img src=x onerror=alert(1)>: no capture can be made of these 1 files").wait_for()


def test_what_a_capture_lacks_leads_to_the_form_that_measures_it(page, solved):
    solved.open(page, "capture")
    expect(page.locator("[data-calibration]")).to_have_count(4)
    for name, state in {"dark": "missing", "flat": "missing", "lights": "there", "colours": "missing"}.items():
        expect(page.locator(f"[data-calibration={name}]")).to_have_class(state)
    expect(page.locator("[data-calibration=lights] button")).to_have_count(0)
    page.locator("[data-calibration=dark]").get_by_role("button", name="Calibrate the dark frame").click()
    form = page.locator("form[data-kind=calibrate-dark]")
    form.get_by_role("button", name="Submit").wait_for()
    expect(form.locator(":focus")).to_have_count(1)


def test_a_preview_shows_the_middle_quarter_and_is_no_result_of_the_object(client, page, solved):
    solved.open(page, "capture")
    page.get_by_role("button", name="Preview the middle").click()
    page.locator("#previewed canvas.map").wait_for(timeout=CONTENT_MS)
    jobs = client.get("/v1/jobs?limit=500").json()["jobs"]
    preview = next(job for job in jobs if job["request"]["name"] == "Preview of the middle")
    view = next(job for job in jobs if job["request"].get("maps") == preview["id"])
    info = client.get(f"/v1/jobs/{view['id']}/results/view.json").json()
    width, height = client.get(f"/v1/captures/{solved.capture}").json()["facts"]["resolution"]
    assert (info["cols"], info["rows"]) == (width // 2, height // 2)
    assert preview["request"]["options"]["crop"][:2] == [width // 4, height // 4]
    page.goto(f"{solved.pages['object']}#mode=maps")
    page.locator("canvas.map").wait_for()
    page.locator("#files a", has_text="maps.exr").wait_for()
    await_whole(page)
    expect(page.locator("main")).not_to_contain_text("Preview of the middle")
    expect(page.locator("#modes button", has_text="Maps")).to_have_count(1)


def test_an_environment_is_deleted(page, client):
    """It has no page of its own; eight seconds pass before it is gone."""
    made = client.post("/v1/environments", json={"name": "dusk"}).raise_for_status().json()["id"]
    page.goto("/captures")
    with page.expect_response(f"**/v1/environments/{made}") as answered:
        page.locator("#environments tr", has_text=made).get_by_role("button", name="Delete dusk").click()
    assert answered.value.status == 204
    await_whole(page)
    expect(page.locator("#environments tr", has_text=made)).to_have_count(0)
