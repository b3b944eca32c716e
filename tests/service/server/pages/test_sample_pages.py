"""The pages on the shipped sample: live relighting is what the batch makes, and pictures of docs/pages.md and of the README, which
`make screenshots` writes into docs/."""

import pytest

from tests.service.server.api.job_calls import admitted
from tests.service.server.pages.conftest import SAMPLES, done, expect, keep, new_context
from tests.service.server.pages.frames import assert_same, picture, rendered
from tests.service.server.pages.photographs import write_photographs
from tests.service.server.pages.test_home_page import await_picture

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def shown(server, client, material, sky) -> dict[str, str]:
    """The addresses of pages by the names of their pictures, of a capture that is solved twice, exported and relit, and of a depth."""
    made = done(server, client, {"kind": "pipeline", "capture": material.capture, "environment": sky, "solve": {"method": "robust"},
                                 "relight": {"frames": "1-12", "spin_degrees": 360}})
    done(server, client, {"kind": "view", "capture": material.capture, "maps": made})
    scanned = admitted(server, client, SAMPLES / "rig")["id"]
    measured = done(server, client, {"kind": "depth", "capture": scanned})
    for maps in ({}, {"maps": measured}):
        done(server, client, {"kind": "view", "capture": scanned, **maps})
    page = material.pages["object"]
    return material.pages | {
        "captures": "/captures", "jobs": "/jobs", "job": f"/jobs/{made}", "maps": f"{material.pages['maps']}#layer=normal&with=roughness",
        "asset": f"{page}#mode=3d", "compare": f"{page}#mode=compare&how=beside", "frames": f"{page}#mode=frames",
        "object": f"{page}#mode=photographs", "depth": f"/object/{scanned}#mode=depth", "fault": "/captures/cap_0123456789abcdefghjk",
        "proposal": "/captures", "machines": "/machines", "home": "/"}


CONTENT = {"captures": "#captures a", "jobs": "#jobs tbody a", "job": "#stages tbody tr", "capture": "#frames canvas",
           "light": "canvas.picture[data-ready]", "maps": "canvas.map", "asset": "canvas.scene[data-share='1']", "compare": "canvas.map",
           "frames": "canvas[data-ready]", "object": "figure canvas", "depth": "canvas.scene[data-share='1']", "fault": ".fault-page",
           "proposal": ".proposal button", "machines": "#audit tbody tr", "home": ".card canvas"}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_page_shows_the_sample(browser, server, shown, owl, solved, sky, tmp_path, scheme):
    context = new_context(browser, base_url=server.url, color_scheme=scheme)
    page = context.new_page()
    for name, content in CONTENT.items():
        page.set_viewport_size({"width": 1280, "height": 720 if name == "home" else 860})
        page.goto("about:blank")
        page.goto(shown[name])
        if name == "proposal":
            page.set_input_files("#folder", write_photographs(tmp_path / "bronze"))
        page.locator(content).first.wait_for()
        if name == "light":
            page.get_by_label("Environment map").select_option(sky)
            page.locator("canvas.preview").wait_for(timeout=60_000)
            page.get_by_label("Brightness of the environment").fill("-3")
            page.get_by_label("View transform").select_option("aces")
            page.get_by_role("button", name="Expose for this light").click()
        if name == "machines":
            page.locator("#workers").get_by_text("cpu").first.wait_for()
            expect(page.get_by_text("Space left")).to_be_visible()
        if name == "home":
            for card in (owl.capture, solved.capture, sky):
                await_picture(page, card)
        if name == "depth":
            page.locator("canvas.scene").scroll_into_view_if_needed()
        else:
            page.evaluate("() => scrollTo(0, 0)")
        page.wait_for_timeout(1500)  # the last tiles, and a frame
        keep(page, f"{name}_{scheme}", tmp_path)
    context.close()


@pytest.mark.parametrize("place", [(0.5, 0.5), (0.75, 0.3), (0.3, 0.8)])
def test_the_light_dragged_over_the_sample_shows_what_the_batch_renders(page, owl, tmp_path, place):
    """The sample has highlights and shadows as sharp as its pixels, and the light is as small as the sun."""
    owl.open(page, "light")
    box = page.locator("canvas.picture").bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"])
    page.mouse.up()
    page.get_by_role("button", name="Expose for this light").click()
    shown = picture(page)
    assert_same(shown, *rendered(page, owl, tmp_path))
