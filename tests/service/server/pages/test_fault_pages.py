"""What goes wrong is said on a page to browsers, and in a problem document to programs; a key that is refused is told why."""

import re
import shutil

import httpx2
import pytest

from service.client import Client
from service.requests.keys import Scope
from tests.scenes.captures import write_capture
from tests.service.server.pages.axe import assert_accessible
from tests.service.server.pages.conftest import SAMPLES, expect, opened_page
from tests.service.server_process import new_key, revoke
from tests.service.waiting import PATIENCE_S

CAPTURE, JOB = "cap_0123456789abcdefghjk", "job_0123456789abcdefghjk"
HTML = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}
FAULTS = {"/nothing": 404, "/captures/%3Cscript%3E": 422, f"/v1/jobs/{JOB}": 404, "/v1/nothing": 404}


@pytest.mark.parametrize("path", FAULTS)
def test_a_browser_gets_a_page_and_a_program_a_problem(without_worker, path):
    with httpx2.Client(base_url=without_worker, timeout=PATIENCE_S) as client:
        page, problem = client.get(path, headers=HTML), client.get(path)
        assert page.status_code == problem.status_code == FAULTS[path]
        assert page.headers["Content-Type"].startswith("text/html") and "default-src 'none'" in page.headers["Content-Security-Policy"]
        assert "<script>" not in page.text and page.headers["X-Request-Id"] in page.text and 'href="/"' in page.text
        assert problem.headers["Content-Type"] == "application/problem+json"
        assert client.post(path, headers=HTML).headers["Content-Type"] == "application/problem+json"


@pytest.mark.long
@pytest.mark.parametrize("path", [f"/captures/{CAPTURE}", f"/jobs/{JOB}", f"/light/{CAPTURE}", f"/maps/{JOB}", "/nothing"])
def test_what_does_not_exist_is_a_page_with_a_way_on(open_to_axe, path):
    open_to_axe.goto(path)
    open_to_axe.locator(".fault-page").wait_for()
    if path.startswith(("/captures/", "/jobs/")):
        open_to_axe.get_by_role("alert").get_by_text(f"there is no {path.rpartition('/')[2]} in this project").wait_for()
    assert_accessible(open_to_axe, 390)
    open_to_axe.get_by_role("link", name="All captures").click()
    open_to_axe.wait_for_url(re.compile("/$"))


@pytest.mark.long
def test_a_view_that_fails_says_why_and_does_not_blame_the_page(server, page, tmp_path):
    with Client(server.url, None) as client:
        capture = client.captures.upload(write_capture(tmp_path / "cap")).id
    shutil.rmtree(server.data / "projects" / "default" / "captures" / capture)
    page.goto(f"/object/{capture}")
    fault = page.get_by_role("alert")
    fault.get_by_text("The view was not prepared: ").wait_for()
    expect(fault).not_to_contain_text("failed")


@pytest.mark.long
def test_the_page_asks_for_a_key_says_why_one_is_refused_and_keeps_it_in_the_tab(browser, locked):
    good, revoked = locked.key("owls", Scope.READ), locked.key()
    with locked.database() as database:
        revoke(database, revoked)
        expired = new_key(database, scope=Scope.READ, expires_days=1e-9)
    with opened_page(browser, base_url=locked.url, bypass_csp=True) as page:
        page.goto("/captures")
        expect(page.get_by_role("textbox", name="Key")).to_be_visible()
        expect(page.locator("#key-fault")).to_be_hidden()
        for given, words in {"wrong": "this service does not know the key", f"{revoked}x": "this service does not know the key",
                             revoked: "the key was revoked on ", expired: "the key expired on "}.items():
            page.get_by_role("textbox", name="Key").fill(given)
            page.get_by_role("button", name="Use this key").click()
            page.locator("#key-fault", has_text=words).wait_for()
        assert_accessible(page)
        page.get_by_role("textbox", name="Key").fill(good)
        page.get_by_role("button", name="Use this key").click()
        page.locator("#captures").get_by_text("There are no captures yet.").wait_for()
        page.reload()
        page.locator("#captures").get_by_text("There are no captures yet.").wait_for()
        page.set_input_files("#file", SAMPLES / "owl" / "environment.exr")
        page.locator("#uploads").get_by_text("the key has the scope read, this needs write").wait_for()
        other = page.context.new_page()
        other.goto("/captures")
        other.get_by_role("button", name="Use this key").wait_for()
        assert page.context.cookies() == []
