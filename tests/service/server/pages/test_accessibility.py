"""Pages are small, pass axe-core without a violation, in light and dark, and fit a narrow screen."""

import pytest

from tests.service.server.pages.axe import assert_accessible, assert_fits
from tests.service.server.pages.conftest import count_bytes, seen

pytestmark = pytest.mark.long

PAGES = {"captures": "/captures", "jobs": "/jobs", "home": "/", "machines": "/machines"}
THREE = "/vendor/three/"
MOST_BYTES = 400_000
"""Of a page without its data and without three.js."""


@pytest.mark.usefixtures("sky")  # a table of nothing fits any screen
@pytest.mark.parametrize("name", [*PAGES, "capture", "job", "light", "object", "maps"])
def test_a_page_is_small_fits_and_has_no_violation(open_to_axe, solved, name):
    page = open_to_axe
    loaded = count_bytes(page, THREE)
    page.goto((PAGES | solved.pages)[name])
    solved.wait_for_content(page, name)
    seen(page, lambda: sum(loaded) > 10_000, "nothing is loaded")
    assert sum(loaded) <= MOST_BYTES
    assert_fits(page, 1280, 640, 390)
    # names were cut to five letters a line beside dates that left the screen of a telephone
    tables = page.locator("#jobs, #captures, #environments")
    assert tables.evaluate_all("tables => tables.every(each => each.scrollWidth <= each.clientWidth)")
    for details in page.locator("details").all():
        details.evaluate("each => { each.open = true; }")
    assert_accessible(page)
