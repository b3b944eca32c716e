"""The page of relit publish --as web in a browser, from a server of files that knows nothing of Relit."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.publish.publish import publish
from service.requests.publish import PublishRequest
from tests.service.publish.published import Files, served, shown
from tests.service.server.pages.axe import violations
from tests.service.server.pages.conftest import PICTURES, SAMPLES, expect, opened_page, seen

pytestmark = pytest.mark.long
MOST_BYTES = 2_000_000
"""What the page may weigh until its first picture, tiles included."""
SMALL = {"width": 900, "height": 480}
"""The processor renders every pixel of the canvas again and again."""
NOTES = ('[{"body": "The beak", "target": "#xywh=145,70,30,50"},'
         ' {"body": "An eye", "target": {"selector": {"type": "PointSelector", "x": 128, "y": 80}}}]')


@pytest.fixture(scope="module")
def owl(tmp_path_factory):
    """The sample, published for OpenLIME, and its page's address."""
    folder = tmp_path_factory.mktemp("published")
    (folder / "notes.json").write_text(NOTES)
    common = {"capture": SAMPLES / "owl", "cache": folder / "cache"}
    publish(PublishRequest(out=folder / "planes", kind="openlime", **common))
    publish(PublishRequest(out=folder / "page", kind="web", annotations=folder / "notes.json", attribution="Relit's sample", **common))
    with served(folder / "page") as address:
        yield folder / "planes", address


@pytest.fixture(params=[False])
def page(browser, request):
    """A page; its policy refuses scripts of others, as those by which tests wait and look are, unless the parameter lifts it."""
    errors = []
    with opened_page(browser, viewport=SMALL, bypass_csp=request.param) as page:
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        yield page
    assert errors == []


def picture(page) -> np.ndarray:
    """[rows, cols, 3] what the canvas shows, 0 to 1."""
    page.locator("#picture[data-ready='whole']").wait_for()
    data = page.evaluate("""async () => {
      const blob = await new Promise((done) => document.getElementById("picture").toBlob(done));
      return Array.from(new Uint8Array(await blob.arrayBuffer()));
    }""")
    return cv2.imdecode(np.array(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255


def test_the_page_shows_the_sample_as_openlime_would(owl, page, tmp_path):
    planes, address = owl
    Files.sent = 0
    if PICTURES:
        page.set_viewport_size({"width": 1200, "height": 800})
    page.goto(f"{address}#light=-0.6,0.3")
    picture(page)
    assert Files.sent < MOST_BYTES
    page.screenshot(path=Path(PICTURES or tmp_path) / "page_publish.png")
    for light in ((0.0, 0.0), (-0.6, 0.3), (0.35, -0.5)):
        page.goto("about:blank")
        page.set_viewport_size({"width": 320 + 272, "height": 1000})
        page.goto(f"{address}?embed#light={light[0]},{light[1]}&zoom=1")
        page.set_viewport_size({"width": 320, "height": 320})  # a pixel of the canvas is one of the image
        seen(page, lambda: picture(page).shape == (320, 320, 3))
        found = picture(page)
        wanted = shown(planes, np.array([[*light, np.sqrt(1 - light[0] ** 2 - light[1] ** 2)]]))[0]
        # the whole planes and the tiles are JPEG files of their own: twice the 1.1 levels that one costs on the sample, and a reserve
        assert 255 * np.sqrt(np.mean(np.square(found - wanted))) < 3


@pytest.mark.parametrize("page", [True], indirect=True)
def test_the_address_keeps_what_is_shown(owl, page):
    page.goto(owl[1])
    picture(page)
    page.locator("#picture").focus()
    for key in ("ArrowLeft", "ArrowUp", "+", "Shift+ArrowRight"):
        page.keyboard.press(key)
    page.wait_for_function(r"/^#light=0\.4,0\.55&stops=0&centre=1[6-9]\d\.?\d*,160&zoom=1\.25$/.test(location.hash)")
    first = picture(page)
    page.reload()
    seen(page, lambda: np.abs(picture(page) - first).max() < 1 / 255)  # the same tiles under the same light
    page.mouse.click(300, 240)
    page.wait_for_function("!location.hash.includes('light=0.4,0.55')")
    page.evaluate("location.hash = '#light=0.4,0.55&stops=0&centre=nonsense&zoom=1e99'")
    page.wait_for_function("document.getElementById('light-x').value === '0.4'")
    page.locator("#picture").focus()
    page.keyboard.press("ArrowDown")  # the address is written anew, with limits kept and nonsense left out
    page.wait_for_function(r"/light=0\.4,0\.5&.*centre=1[6-9]\d\.?\d*,160&zoom=6\.4$/.test(location.hash)")  # 320 pixels / 50
    page.locator("#texts button", has_text="The beak").click()
    page.wait_for_function("location.hash.includes('centre=160,95')")
    page.locator("#embed summary").click()
    page.wait_for_function("document.querySelector('#embed textarea').value.includes('?embed#light')")


@pytest.mark.parametrize("page", [True], indirect=True)
@pytest.mark.parametrize("viewport", [(1000, 500), (390, 600)])
def test_the_page_can_be_used_by_everybody(owl, page, viewport):
    page.set_viewport_size({"width": viewport[0], "height": viewport[1]})
    page.goto(owl[1])
    picture(page)
    page.wait_for_function("document.documentElement.scrollWidth <= innerWidth")
    assert violations(page) == []


@pytest.mark.parametrize("page", [True], indirect=True)
def test_another_page_embeds_it_with_its_scale_and_fills_the_screen_with_it(owl, page):
    page.goto(owl[1])
    picture(page)
    page.locator("#embed summary").click()
    page.wait_for_function("document.querySelector('#embed textarea').value !== ''")  # it is written when the browser says that it is open
    code = page.locator("#embed textarea").input_value()
    bar = page.locator("#scale")

    def is_true() -> bool:
        length = {"4 cm": 40, "5 cm": 50, "2 cm": 20, "1 cm": 10}[bar.inner_text()]
        zoom = page.evaluate("document.getElementById('stage').getBoundingClientRect().height") / 320  # the whole height is shown
        return bar.bounding_box()["width"] == pytest.approx(length / 0.675 * zoom, rel=0.02)  # pixels of .675 mm; the border

    seen(page, is_true, "the scale bar is wrong")
    page.locator("#full").click()
    page.wait_for_function("document.fullscreenElement?.id === 'stage'")
    page.keyboard.press("Escape")
    page.route(f"{owl[1]}museum.html", lambda route: route.fulfill(body=code, content_type="text/html"))
    page.goto(f"{owl[1]}museum.html")
    frame = page.frame_locator("iframe")
    frame.locator("#picture[data-ready='whole']").wait_for()
    expect(frame.locator("h1:visible")).to_have_count(0)


@pytest.mark.parametrize("page", [True], indirect=True)
def test_the_first_picture_needs_a_part_of_what_a_line_carries_in_two_seconds(owl, page):
    """Bytes, not seconds: 10 Mbit/s carry 2.5 MB in two; the finer tiles are held back until the first picture is there."""
    held = []
    page.route("**/plane_*_files/1/**", lambda route: held.append(route))
    Files.sent = 0
    page.goto(owl[1])
    page.locator("#picture[data-ready='coarse']").wait_for()
    assert 100_000 < Files.sent < 2_500_000 / 4
    assert held
    page.unroute("**/plane_*_files/1/**")  # which lets them go on
    picture(page)


@pytest.mark.parametrize("page", [True], indirect=True)
def test_one_finger_moves_the_light_or_the_picture(owl, page):
    page.goto(f"{owl[1]}#light=0,0")
    picture(page)
    box, finger = page.locator("#picture").bounding_box(), page.context.new_cdp_session(page)

    def drag(across):
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        for kind, part in (("touchStart", 0), ("touchMove", 0.5), ("touchMove", 1), ("touchEnd", None)):
            points = [] if part is None else [{"x": middle[0] + part * across, "y": middle[1], "id": 0}]
            finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    half = min(box["width"], box["height"]) / 2
    drag(half / 2)
    page.wait_for_function("Math.abs(Number(location.hash.match(/light=([-\\d.]+),/)?.[1]) - .5) < .02")
    page.locator("#mode-move").click()
    drag(-half / 2)  # half of the height is 160 pixels of the image, a quarter 80
    page.wait_for_function("Math.abs(Number(location.hash.match(/centre=([\\d.]+),/)?.[1]) - 240) < 3")
    assert re.search(r"light=0\.(49|5|51)\d*,", page.evaluate("location.hash"))


@pytest.mark.parametrize("page", [True], indirect=True)
def test_two_fingers_zoom(owl, page):
    page.goto(owl[1])
    picture(page)
    box, fingers = page.locator("#picture").bounding_box(), page.context.new_cdp_session(page)
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80), ("touchEnd", None)):
        points = [] if apart is None else [{"x": middle[0] + side * apart, "y": middle[1], "id": number}
                                           for number, side in enumerate((-1, 1))]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    # from 80 to 160 pixels apart; the address follows each move a moment later
    page.wait_for_function("Math.abs(Number(location.hash.match(/zoom=([\\d.]+)/)?.[1]) - 2) < .04")


def test_a_folder_that_lacks_its_tiles_says_so(owl, browser):
    with opened_page(browser) as page:
        page.route("**/plane_3_files/**", lambda route: route.fulfill(status=404))
        page.goto(owl[1])
        page.locator("#state", has_text="cannot be read (404)").wait_for()
