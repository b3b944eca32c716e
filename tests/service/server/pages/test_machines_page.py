"""The page for operators: workers, queue, space, errors and the audit log, for those who may see them."""

import pytest

from service.requests.keys import Scope
from tests.service.server.pages.axe import violations_in_both_schemes
from tests.service.server.pages.conftest import await_whole, expect, keep, new_context
from tests.service.server_process import serving

pytestmark = pytest.mark.long


def opened(browser, url: str, key: str, **options):
    """The page with a key in the tab."""
    page = new_context(browser, base_url=url, bypass_csp=True, **options).new_page()
    page.add_init_script(f"sessionStorage.setItem('relit-key', '{key}')")
    page.goto("/machines")
    return page


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_of_machines_shows_the_sample(browser, server, solved, tmp_path, scheme):
    context = new_context(browser, base_url=server.url, bypass_csp=True, viewport={"width": 1280, "height": 860}, color_scheme=scheme)
    page = context.new_page()
    page.goto("/machines")
    page.locator("#workers").get_by_text("cpu").first.wait_for()
    page.locator("#audit tbody tr").nth(1).wait_for()
    expect(page.get_by_text("Space left")).to_be_visible()
    keep(page, f"machines_{scheme}", tmp_path)
    if scheme == "light":
        page.set_viewport_size({"width": 390, "height": 844})
        page.wait_for_function("() => document.documentElement.scrollWidth <= 390")
        assert violations_in_both_schemes(page) == []
    page.close()


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
    page = opened(browser, locked.url, locked.key("birds"))
    page.get_by_text("No worker was seen lately.").wait_for()
    page.get_by_text("no worker was seen in the last 30 seconds").wait_for()
    expect(page.locator("#audit tbody tr")).to_have_count(50)
    page.get_by_role("button", name="Show older lines").click()
    page.wait_for_function("() => document.querySelectorAll('#audit tbody tr').length === 60")
    expect(page.locator("main img")).to_have_count(0)
    expect(page.get_by_role("button", name="Show older lines")).to_be_hidden()
    page.close()


def test_who_may_not_see_machines_is_told_so(browser, locked):
    page = opened(browser, locked.url, locked.key("birds", Scope.WRITE))
    page.get_by_text("This page is for operators: the key has the scope write, this needs admin").wait_for()
    await_whole(page)
    expect(page.locator("#view")).to_be_hidden()
    expect(page.locator(".skeleton:visible")).to_have_count(0)
    page.close()
