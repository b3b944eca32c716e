"""The pages on the shipped sample: live relighting is what the batch makes, and pictures of docs/pages.md and of the README, which
`make screenshots` writes into docs/."""

from pathlib import Path

import pytest

from tests.service.server.pages.conftest import PICTURES, new_context
from tests.service.server.pages.frames import assert_same, picture, rendered


@pytest.mark.long
@pytest.mark.parametrize("name", ["light", "object", "maps", "capture"])
def test_a_page_shows_the_sample(browser, owl, material, sky, tmp_path, name):
    sample = material if name == "maps" else owl
    page = new_context(browser, base_url=sample.server.url, viewport={"width": 1280, "height": 860}, color_scheme="dark").new_page()
    page.goto(sample.pages[name])
    sample.wait_for_content(page, name)
    if name == "light":
        page.get_by_label("Environment map").select_option(sky)
        page.locator("canvas.preview").wait_for(timeout=60_000)
        page.get_by_label("Brightness of the environment").fill("-3")
        page.get_by_role("button", name="Expose for this light").click()
    if name == "maps":
        page.get_by_label("Compare with", exact=True).first.select_option("roughness")
    if name == "object":
        page.get_by_role("button", name="Photographs").click()
        page.locator("[data-shows=photographs] figure").first.wait_for()
    page.evaluate("() => scrollTo(0, 0)")
    page.wait_for_timeout(1500)  # the last tiles, and a frame
    path = (Path(PICTURES) if PICTURES else tmp_path) / f"page_{name}.png"
    page.screenshot(path=path)
    assert path.stat().st_size > 50_000
    page.close()


@pytest.mark.long
@pytest.mark.parametrize("place", [(0.5, 0.5), (0.75, 0.3), (0.3, 0.8)])
def test_the_light_dragged_over_the_sample_shows_what_the_batch_renders(page, owl, tmp_path, place):
    """The sample has highlights and shadows as sharp as its pixels, and the light is as small as the sun."""
    page.goto(owl.pages["light"])
    owl.wait_for_content(page, "light")
    box = page.locator("canvas.picture").bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"])
    page.mouse.up()
    page.get_by_role("button", name="Expose for this light").click()
    shown = picture(page)
    assert_same(shown, *rendered(page, owl, tmp_path))
