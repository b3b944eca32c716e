"""Pages are small, pass axe-core without a violation, in light and dark, and fit a narrow screen."""

import pytest

from tests.service.server.pages.axe import violations_in_both_schemes
from tests.service.server.pages.conftest import count_bytes, new_context, seen

pytestmark = pytest.mark.long

PAGES = {"captures": "/captures", "jobs": "/jobs", "home": "/", "machines": "/machines"}
THREE = "/vendor/three/"
MOST_BYTES = 400_000
"""Of a page without its data and without three.js."""


@pytest.mark.usefixtures("sky")  # a table of nothing fits any screen
@pytest.mark.parametrize("name", [*PAGES, "capture", "job", "light", "object", "maps"])
def test_a_page_is_small_fits_and_has_no_violation(browser, server, solved, name):
    page = new_context(browser, base_url=server.url, bypass_csp=True).new_page()  # axe is injected
    loaded = count_bytes(page, THREE)
    page.goto((PAGES | solved.pages)[name])
    solved.wait_for_content(page, name)
    seen(page, lambda: sum(loaded) > 10_000, "nothing is loaded")
    assert sum(loaded) <= MOST_BYTES
    for width in (1280, 640, 390):  # 640 px: a screen of 1280 px at 200 %
        page.set_viewport_size({"width": width, "height": 844})
        page.wait_for_function("(width) => document.documentElement.scrollWidth <= width", arg=width)
    # names were cut to five letters a line beside dates that left the screen of a telephone
    tables = page.locator("#jobs, #captures, #environments")
    assert tables.evaluate_all("tables => tables.every(each => each.scrollWidth <= each.clientWidth)")
    for details in page.locator("details").all():
        details.evaluate("each => { each.open = true; }")
    assert violations_in_both_schemes(page) == []
    page.close()
