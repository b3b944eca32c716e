"""The pictures of docs/pages.md and of the README: the pages on the shipped sample. `make screenshots` writes them into docs/."""

import os
from pathlib import Path

import pytest

FOLDER = os.environ.get("RELIT_TEST_SCREENSHOTS")
"""Where the pictures go; without it they are made and dropped."""


@pytest.mark.long
@pytest.mark.parametrize("name", ["light", "maps", "capture"])
def test_a_page_shows_the_sample(browser, owl, sky, tmp_path, name):
    page = browser.new_page(base_url=owl.server.url, viewport={"width": 1280, "height": 860}, color_scheme="dark")
    page.goto(owl.pages[name])
    owl.wait_for_content(page, name)
    if name == "light":
        page.get_by_label("Environment map").select_option(sky)
        page.locator("canvas.preview").wait_for(timeout=60_000)
        page.get_by_label("Brightness of the environment").fill("-3")
        page.get_by_role("button", name="Expose for this light").click()
    if name == "maps":
        page.get_by_label("Compare with", exact=True).first.select_option("roughness")
    page.evaluate("() => scrollTo(0, 0)")
    page.wait_for_timeout(1500)  # the last tiles, and a frame
    path = (Path(FOLDER) if FOLDER else tmp_path) / f"page_{name}.png"
    page.screenshot(path=path)
    assert path.stat().st_size > 50_000
    page.close()
