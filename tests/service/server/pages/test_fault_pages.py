"""What goes wrong is said on a page to browsers, and in a problem document to programs; a key that is refused is told why."""

import re

import pytest

from service.requests.keys import Scope
from tests.service.server.pages.axe import violations_in_both_schemes
from tests.service.server.pages.conftest import SAMPLES, expect, new_context
from tests.service.server_process import new_key, revoke, serving

CAPTURE, JOB = "cap_0123456789abcdefghjk", "job_0123456789abcdefghjk"
HTML = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}
FAULTS = {"/nothing": 404, "/captures/%3Cscript%3E": 422, f"/v1/jobs/{JOB}": 404, "/v1/nothing": 404}


@pytest.mark.parametrize("path", FAULTS)
def test_a_browser_gets_a_page_and_a_program_a_problem(server, path):
    with server.client() as client:
        page, problem = client.get(path, headers=HTML), client.get(path)
        assert page.status_code == problem.status_code == FAULTS[path]
        assert page.headers["Content-Type"].startswith("text/html") and "default-src 'none'" in page.headers["Content-Security-Policy"]
        assert "<script>" not in page.text and page.headers["X-Request-Id"] in page.text and 'href="/"' in page.text
        assert problem.headers["Content-Type"] == "application/problem+json"
        assert client.post(path, headers=HTML).headers["Content-Type"] == "application/problem+json"


@pytest.mark.long
@pytest.mark.parametrize("path", [f"/captures/{CAPTURE}", f"/jobs/{JOB}", f"/light/{CAPTURE}", f"/maps/{JOB}", "/nothing"])
def test_what_does_not_exist_is_a_page_with_a_way_on(browser, server, path):
    page = new_context(browser, base_url=server.url, bypass_csp=True, viewport={"width": 390, "height": 844}).new_page()
    page.goto(path)
    page.locator(".fault-page").wait_for()
    page.wait_for_function("() => document.documentElement.scrollWidth <= 390")
    assert violations_in_both_schemes(page) == []
    page.get_by_role("link", name="All captures").click()
    page.wait_for_url(re.compile("/$"))
    page.close()


@pytest.mark.long
def test_a_key_that_is_refused_is_told_why(browser, tmp_path):
    with serving(tmp_path, "--device", "none", roots=str(SAMPLES)) as locked, locked.database() as database:
        good, revoked = locked.key(scope=Scope.READ), locked.key()
        revoke(database, revoked)
        expired = new_key(database, scope=Scope.READ, expires_days=1e-9)
        page = new_context(browser, base_url=locked.url, bypass_csp=True).new_page()
        page.goto("/captures")
        fault = page.locator("#key-fault")
        expect(page.get_by_role("textbox", name="Key")).to_be_visible()
        expect(fault).to_be_hidden()
        for given, words in {"wrong": "this service does not know the key", f"{revoked}x": "this service does not know the key",
                             revoked: "the key was revoked on ", expired: "the key expired on "}.items():
            page.get_by_role("textbox", name="Key").fill(given)
            page.get_by_role("button", name="Use this key").click()
            page.locator("#key-fault", has_text=words).wait_for()
        assert violations_in_both_schemes(page) == []
        page.get_by_role("textbox", name="Key").fill(good)
        page.get_by_role("button", name="Use this key").click()
        page.get_by_text("There are no captures yet.").wait_for()
        page.close()
