"""The page for operators: workers, queue, space, errors and the audit log, for those who may see them."""

from contextlib import contextmanager

import pytest

from service.requests.keys import Scope
from tests.service.server.pages.conftest import await_whole, expect, new_context, opened_page
from tests.service.server_process import serving

pytestmark = pytest.mark.long


@contextmanager
def opened(browser, url: str, key: str):
    """The page with a key in the tab."""
    with opened_page(browser, base_url=url) as page:
        page.add_init_script(f"sessionStorage.setItem('relit-key', '{key}')")
        page.goto("/machines")
        yield page


def test_a_worker_is_drained_and_killed_and_another_takes_its_place(browser, tmp_path):
    with serving(tmp_path, "--anonymous", "--device", "cpu", takeover_s="0.2") as server:
        page = new_context(browser, base_url=server.url).new_page()
        page.on("dialog", lambda dialog: dialog.accept())
        page.goto("/machines")
        for what in ("Drain", "Kill"):
            button = page.get_by_role("button", name=f"{what} cpu, process")
            button.first.wait_for()
            before = button.first.get_attribute("aria-label")
            page.get_by_role("button", name=before, exact=True).click()
            page.wait_for_function("([what, before]) => [...document.querySelectorAll('#workers button')].some((each) => !each.disabled"
                                   " && each.textContent === what && each.getAttribute('aria-label') !== before)", arg=[what, before])
            page.wait_for_function("(before) => [...document.querySelectorAll('#workers button')]"
                                   ".every((each) => each.getAttribute('aria-label') !== before)", arg=before)
        page.reload()
        page.locator("#audit tbody tr").nth(1).wait_for()
        expect(page.locator("#audit tbody td:nth-child(3)")).to_have_text(["Worker: kill", "Worker: drain"])
        page.close()


def test_the_audit_log_is_paged_and_names_stay_text(browser, locked):
    with locked.client(locked.key("birds")) as client:
        for number in range(60):
            client.post("/v1/captures", json={"name": f"<img src=x onerror=alert({number})>"}).raise_for_status()
    with opened(browser, locked.url, locked.key("birds")) as page:
        page.get_by_text("No worker was seen lately.").wait_for()
        page.get_by_text("no worker was seen in the last 30 seconds").wait_for()
        expect(page.locator("#audit tbody tr")).to_have_count(50)
        page.get_by_role("button", name="Show older lines").click()
        page.wait_for_function("() => document.querySelectorAll('#audit tbody tr').length === 60")
        expect(page.locator("main img")).to_have_count(0)
        expect(page.get_by_role("button", name="Show older lines")).to_be_hidden()


def test_who_may_not_see_machines_is_told_so(browser, locked):
    with opened(browser, locked.url, locked.key("birds", Scope.WRITE)) as page:
        page.get_by_text("This page is for operators: the key has the scope write, this needs admin").wait_for()
        await_whole(page)
        expect(page.locator("#view")).to_be_hidden()
        expect(page.locator(".skeleton:visible")).to_have_count(0)
