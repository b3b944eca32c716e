"""Pictures while something moves: small where the machine is slow, whole when it is still; and nothing of a page moves by itself."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from docs.tools.view_table import FIRST, SIDE, STOPS, view_table
from service.server.pages.routes import HOME
from stage.colour.colour import through_view
from stage.colour.colour_spaces import Review
from tests.reference.colour import srgb_to_linear
from tests.service.server.pages.conftest import new_context
from tests.service.server.pages.frames import picture

SLOW = """async () => {
  const { DrawLoop } = await import("/static/view/light/draw_loop.js");
  const [rows, cols, speed] = [1000, 1000, 500]; // pixels per ms: a whole picture takes two seconds
  const drawn = [];
  const pixels = ({ stride = 1, band = [0, rows] }) => (band[1] - band[0]) * cols / stride ** 2;
  const renderer = { relight: { rows, cols }, draw: (each) => drawn.push(each), isPast: (time) => performance.now() >= time,
    fence: () => performance.now() + pixels(drawn.at(-1)) / speed };
  const shown = [];
  const loop = new DrawLoop(renderer, (stride) => shown.push([stride, drawn.at(-1).at]));
  for (let at = 0; at < 40; at += 1) {
    loop.ask({ at });
    await new Promise(requestAnimationFrame);
  }
  await loop.settled();
  const isBand = ({ band }) => band !== undefined;
  return { moving: drawn.filter((each) => !isBand(each)).map(({ stride }) => stride), bands: drawn.filter(isBand), shown };
}"""
SLOW_SCENE = """async () => {
  const { SceneLoop } = await import("/static/scene/scene_loop.js");
  const [canvas, drawn] = [document.createElement("canvas"), new OffscreenCanvas(400, 400)];
  const [pen, speed] = [drawn.getContext("2d"), 400]; // pixels per ms: a whole picture takes 400 ms
  let [size, at, looks, clock] = [null, 0, 0, 0];
  performance.now = () => clock; // of a machine that never halts, as this one may
  const gl = { flush: () => {}, isContextLost: () => false, deleteSync: () => {}, SIGNALED: true,
    fenceSync: () => performance.now() + size[0] * size[1] / speed,
    getSyncParameter: (time) => { looks += 1; clock += 4; return clock >= time; } };
  const renderer = { domElement: drawn, getContext: () => gl, getPixelRatio: () => 1,
    setViewport: (x, y, ...given) => { size = given; } };
  const loop = new SceneLoop(renderer, canvas, () => { pen.fillStyle = `rgb(${at} 0 0)`; pen.fillRect(0, 400 - size[1], ...size); });
  const shown = [];
  new MutationObserver(() => shown.push([Number(canvas.dataset.share), canvas.getContext("2d").getImageData(399, 399, 1, 1).data[0]]))
    .observe(canvas, { attributes: true });
  for (at = 0; at < 40; at += 1) {
    loop.changed();
    clock += 16;
    await new Promise(requestAnimationFrame);
  }
  loop.changed();
  const ticking = setInterval(() => { clock += 50; }, 1);
  await loop.settled();
  clearInterval(ticking);
  return { shown, looks };
}"""
LARGEST_SHIFT = 7e-4
"""Less than a line of text across the page that moves by its own height: 20 × 1248 of 1280 × 860 px, twice, times 20 of 1280 px."""
SHIFTS = """globalThis.shifts = [];
new PerformanceObserver((list) => {
  const words = ({ node, previousRect: { x, y }, currentRect: to }) => `${node?.id || node?.className} from ${x},${y} to ${to.x},${to.y}`;
  for (const each of list.getEntries()) if (!each.hadRecentInput) shifts.push([each.value, ...each.sources.map(words)]);
}).observe({ type: "layout-shift", buffered: true });"""


@pytest.mark.long
def test_a_slow_machine_draws_less_while_something_moves_and_all_of_it_in_bands_afterwards(page):
    page.goto("/jobs")
    found = page.evaluate(SLOW)
    assert min(found["moving"]) > 1  # of a whole picture nothing is drawn while it moves
    bands = [each["band"] for each in found["bands"]]
    assert [band[0] for band in bands] == [0, *(band[1] for band in bands[:-1])] and bands[-1][1] == 1000  # each row once, in order
    assert len(bands) > 10  # none of them holds a new motion up for long
    assert [each.get("isSame", False) for each in found["bands"]] == [False, *[True] * (len(bands) - 1)]
    assert found["shown"][-1] == [1, 39] and all(stride > 1 for stride, _ in found["shown"][:-1])


@pytest.mark.long
def test_a_scene_is_shown_when_it_is_drawn_in_fewer_pixels_while_it_moves(page):
    """The context has nothing that waits for a drawing: a call of it would fail."""
    page.goto("/jobs")
    found = page.evaluate(SLOW_SCENE)
    assert found["shown"][-1] == [1, 40] and all(share < 1 for share, _ in found["shown"][:-1])
    assert len(found["shown"]) > 2 and found["looks"] >= len(found["shown"])


@pytest.mark.long
def test_light_through_aces_is_what_the_service_shows(page, solved):
    page.goto(f"{solved.pages['light']}#view=aces&stops=1")
    solved.wait_for_content(page, "light")
    shown = picture(page)
    page.get_by_label("View transform").select_option("srgb")
    page.wait_for_function("() => !location.hash.includes('view=')")
    assert np.abs(picture(page) - shown).mean() > 0.02
    page.get_by_label("Exposure in stops").fill("-1")  # nothing is clipped: what is shown tells the linear light
    clipped = picture(page)
    linear = srgb_to_linear(clipped)
    inside = (clipped < 0.95).all(axis=-1) & (clipped > 0.25).all(axis=-1)  # where a step of 1/255 is a small part of the light
    expected = through_view(np.ascontiguousarray(4 * linear[inside][None]).astype(np.float32), "lin_rec709_scene", Review(None, None))[0]
    assert inside.sum() > 500
    assert np.abs(shown[inside] - expected).mean() < 2 / 255  # half a step of each picture, and a quarter of one of the table


def test_the_table_of_aces_is_that_of_the_service():
    stored = np.frombuffer((HOME / "static" / "view" / "aces.bin").read_bytes(), dtype=np.uint8)
    assert np.abs(stored.astype(int) - np.frombuffer(view_table(), dtype=np.uint8)).max() <= 1  # rounding of another processor
    random = np.random.default_rng(1)
    light = (2.0 ** random.uniform(-9, 5, (10_000, 1)) * random.uniform(0.05, 1, (10_000, 3))).astype(np.float32)
    places = (SIDE - 1) * np.clip((np.log2(light) - FIRST) / STOPS, 0, 1)
    table = stored.reshape(SIDE, SIDE, SIDE, 3).astype(float)
    shown = np.stack([map_coordinates(table[..., each], places[:, ::-1].T, order=1) for each in range(3)], axis=-1)
    expected = 255 * through_view(light[None], "lin_rec709_scene", Review(None, None))[0]
    assert np.percentile(np.abs(shown - expected), 99) < 1.5  # as docs/pages.md says
    script = (HOME / "static" / "view" / "view_transforms.js").read_text()
    assert f"{{ side: {SIDE}, first: {FIRST:g}, stops: {STOPS:g} }}" in script


@pytest.mark.long
def test_nothing_that_is_seen_moves_by_itself(browser, server, solved):
    """The browser's own measure, of all pages from their first paint on; none of it follows an input."""
    context = new_context(browser, base_url=server.url, viewport={"width": 1280, "height": 860})
    context.add_init_script(SHIFTS)
    page = context.new_page()
    found = {}
    addresses = {"home": "/", "captures": "/captures", "jobs": "/jobs", "machines": "/machines", **solved.pages}
    for name, address in addresses.items():
        page.goto("about:blank")
        page.goto(address)
        solved.wait_for_content(page, name)
        page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        found[name] = page.evaluate("shifts")
    context.close()
    assert {name: shifts for name, shifts in found.items() if sum(value for value, *_ in shifts) > LARGEST_SHIFT} == {}
