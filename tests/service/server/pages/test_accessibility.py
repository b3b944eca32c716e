"""Pages pass axe-core without a serious violation, in light and dark, and fit a narrow screen."""

import pytest

from tests.service.server.pages.axe import violations

PAGES = {"captures": "/captures", "jobs": "/jobs"}


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", [*PAGES, "capture", "job", "light", "maps"])
def test_no_serious_violation(browser, server, solved, name, scheme):
    page = browser.new_page(base_url=server.url, color_scheme=scheme, bypass_csp=True)  # axe is injected
    page.goto((PAGES | solved.pages)[name])
    solved.wait_for_content(page, name)
    for details in page.locator("details").all():
        details.evaluate("each => { each.open = true; }")
    assert violations(page) == []
    page.close()


@pytest.mark.parametrize("name", [*PAGES, "capture", "job", "light", "maps"])
def test_a_narrow_screen_needs_no_scrolling_to_the_side(browser, server, solved, name):
    page = browser.new_page(base_url=server.url, viewport={"width": 390, "height": 844})
    page.goto((PAGES | solved.pages)[name])
    solved.wait_for_content(page, name)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.close()
