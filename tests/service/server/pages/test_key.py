"""A service that wants keys: the page asks for one, keeps it in its tab, and says what a key does not allow."""

import pytest

from service.requests.keys import Scope
from tests.service.server.pages.conftest import SAMPLES, new_context


@pytest.mark.long
def test_the_page_asks_for_a_key_and_keeps_it_in_the_tab(browser, locked):
    context = new_context(browser, base_url=locked.url)
    page = context.new_page()
    page.goto("/captures")
    page.get_by_label("Key", exact=True).last.fill("wrong")
    page.get_by_role("button", name="Use this key").click()
    page.get_by_label("Key", exact=True).last.fill(locked.key("owls", Scope.READ))
    page.get_by_role("button", name="Use this key").click()
    page.locator("#captures").get_by_text("There are no captures yet.").wait_for()
    page.reload()
    page.locator("#captures").get_by_text("There are no captures yet.").wait_for()
    page.set_input_files("#file", SAMPLES / "owl" / "environment.exr")
    page.locator("#uploads").get_by_text("the key has the scope read, this needs write").wait_for()
    other = context.new_page()
    other.goto("/captures")
    other.get_by_role("button", name="Use this key").wait_for()
    assert context.cookies() == []
    context.close()
