"""What the page of an object offers next, also while its capture is being checked and its view waits for other jobs."""

import pytest

from tests.service.server.pages.conftest import alter, expect, seen

pytestmark = pytest.mark.long


def test_a_capture_can_be_worked_on_while_its_view_waits_for_other_jobs(client, small_page, solved):
    """The capture is being checked at first. A button that asks for a job rests while such a job is under way."""
    page, states, submitted = small_page, ["checking", "ready"], []

    def submit(route):
        submitted.append(route.request.post_data_json)
        route.fulfill(status=202, json=waiting)

    job = client.get(f"/v1/jobs/{solved.solve}").json()
    waiting = {**job, "state": "queued", "request": {"kind": "pipeline", "capture": solved.capture}}
    alter(page, "**/v1/jobs?kind=view&limit=500&state=succeeded&state=queued&state=running", lambda found: found | {
        "jobs": [{**job, "state": "queued"} for job in found["jobs"]]})
    page.route("**/v1/jobs?limit=500&state=succeeded", lambda route: route.fulfill(json={"jobs": [], "next": None}))
    alter(page, f"**/v1/captures/{solved.capture}", lambda capture: capture | {
        "view": None, "state": states.pop(0) if states else "ready"})
    page.route("**/v1/jobs/*/events", lambda route: None)  # it never ends
    page.route("**/v1/events", lambda route: None)
    page.route("**/v1/jobs", submit)
    page.goto(solved.pages["object"])
    page.get_by_text("This capture is being checked.").wait_for()
    page.get_by_text("its view is being prepared").wait_for()
    asset = page.get_by_role("button", name="Make an asset")
    asset.click()
    page.locator("#work li", has_text="waits for a free worker").wait_for()
    expect(asset).to_be_disabled()
    assert [each["kind"] for each in submitted] == ["pipeline"]
    page.goto(solved.pages["capture"])
    page.get_by_text("its view is being prepared").wait_for()
    expect(page.get_by_role("button", name="Solve normals and materials")).to_be_visible()
    expect(page.locator("#facts")).to_be_visible()


def test_maps_are_exported_without_another_solve(client, small_page, solved):
    page, submitted = small_page, []

    def submit(route):
        submitted.append(route.request.post_data_json)
        route.fulfill(status=503, json={"detail": "the service takes no jobs now"})

    alter(page, "**/v1/jobs?limit=500&state=succeeded", lambda found: found | {
        "jobs": [job for job in found["jobs"] if job["request"]["kind"] != "export"]})
    page.route("**/v1/jobs", submit)
    page.goto(f"{solved.pages['object']}#mode=photographs")
    page.get_by_role("button", name="Export an asset").click()
    newest = seen(page, lambda: submitted, "nothing is submitted")[0]
    solve = client.get(f"/v1/jobs/{newest['maps']}").json()["request"]
    assert newest == {"kind": "export", "maps": newest["maps"]} and (solve["kind"], solve["capture"]) == ("solve", solved.capture)
    expect(page.get_by_role("button", name="Make an asset")).to_be_hidden()
