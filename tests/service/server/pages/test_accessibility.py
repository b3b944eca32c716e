"""Pages pass axe-core without a serious violation, in light and dark, and fit a narrow screen."""

import pytest

from tests.service.server.pages.axe import violations

PAGES = {"captures": "/captures", "jobs": "/jobs"}


@pytest.mark.parametrize("name", [*PAGES, "capture", "job", "light", "maps"])
def test_no_serious_violation_and_no_scrolling_to_the_side(browser, server, solved, name):
    page = browser.new_page(base_url=server.url, bypass_csp=True)  # axe is injected
    page.goto((PAGES | solved.pages)[name])
    solved.wait_for_content(page, name)
    for width in (1280, 390):
        page.set_viewport_size({"width": width, "height": 844})
        page.wait_for_function("(width) => document.documentElement.scrollWidth <= width", arg=width)
    for details in page.locator("details").all():
        details.evaluate("each => { each.open = true; }")
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        assert violations(page) == []
    page.close()
