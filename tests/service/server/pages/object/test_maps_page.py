"""The page of maps shows the values of the file, marks what is unsure, and plots the readings of a pixel."""

import re

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.results.maps import SurfaceMaps
from stage.stack.correction import Correction
from tests.service.server.pages.conftest import SAMPLES, expect, seen, spread_fingers

pytestmark = pytest.mark.long

DRAWN = """(canvas) => {
  const pen = canvas.getContext("2d");
  const isOpaque = (x) => pen.getImageData(canvas.width / 2 + x, canvas.height / 2, 1, 1).data[3] === 255;
  return isOpaque(-20) && isOpaque(20) ? canvas.toDataURL() : null;
}"""
"""The picture of the map, or null as long as nothing is drawn beside its middle."""


@pytest.fixture(scope="module")
def maps(solved, tmp_path_factory) -> SurfaceMaps:
    return SurfaceMaps.read(solved.result(solved.solve, "maps.exr", tmp_path_factory.mktemp("maps")))


@pytest.fixture
def opened(page, solved):
    solved.open(page, "maps")
    return page


def point_at(page, row: int, col: int, side: int) -> str:
    """Point at a pixel of the map, which is shown as a whole; return what the page says of it."""
    page.wait_for_function("""() => {
      const canvas = document.querySelector("canvas.map"), { width, height } = canvas.getBoundingClientRect();
      return canvas.width === Math.round(width * devicePixelRatio) && canvas.height === Math.round(height * devicePixelRatio);
    }""")
    box = page.locator("canvas.map").bounding_box()
    scale = min(box["width"], box["height"]) / side
    x = box["x"] + box["width"] / 2 + (col + 0.5 - side / 2) * scale
    y = box["y"] + box["height"] / 2 + (row + 0.5 - side / 2) * scale
    page.mouse.move(x, y)
    said = page.locator("output.value")
    said.get_by_text(f"row {row}, column {col}:").wait_for()
    return said.inner_text()


def drawn(page, *others: str) -> str:
    """What the map shows, when its tile has come and it is none of these pictures."""
    canvas = page.locator("canvas.map")
    return seen(page, lambda: (found := canvas.evaluate(DRAWN)) not in (None, *others) and found, "the map is not drawn")


def shown_again(page, picture: str) -> None:
    """Wait until the map shows a picture that it has shown before."""
    canvas = page.locator("canvas.map")
    seen(page, lambda: canvas.evaluate(DRAWN) == picture, "the map is another")


def numbers(said: str, title: str) -> list[float]:
    return [float(each) for each in re.search(rf"{title} ([^;a-z]+)", said)[1].replace("−", "-").split(",")]


@pytest.mark.parametrize(("layer", "title"), [("normal", "Normals"), ("diffuse_albedo", "Diffuse albedo"), ("height", "Height")])
def test_the_value_under_the_cursor_is_that_of_the_file(opened, maps, layer, title):
    """Four significant digits are shown."""
    opened.get_by_label("Layer", exact=True).first.select_option(layer)
    rows, cols = np.nonzero(maps.mask)
    for at in (0, len(rows) // 3, len(rows) // 2, len(rows) - 1):
        said = point_at(opened, int(rows[at]), int(cols[at]), len(maps.mask))
        expected = np.atleast_1d(getattr(maps, layer)[rows[at], cols[at]])
        assert np.allclose(numbers(said, title), expected, rtol=5e-4, atol=1e-6)
        assert "status: " in said


@pytest.mark.parametrize(("by", "title", "sign"), [("confidence", "Confidence", -1), ("sigma", "Standard error of the normal", 1)])
def test_what_is_less_sure_is_greyed_out(opened, maps, by, title, sign):
    """Grey is 128 in each channel; the veil covers at most 235 of 255."""
    doubt = np.where(maps.mask > 0, sign * np.asarray(getattr(maps, by), dtype=float), np.nan)
    surest, least = (np.unravel_index(find(doubt), doubt.shape) for find in (np.nanargmin, np.nanargmax))

    def colour(at) -> np.ndarray:
        return np.array(opened.locator("canvas.map").evaluate("""(canvas, [row, col, side]) => {
          const scale = Math.min(canvas.width, canvas.height) / side;
          const [x, y] = [canvas.width / 2 + (col + 0.5 - side / 2) * scale, canvas.height / 2 + (row + 0.5 - side / 2) * scale];
          return [...canvas.getContext("2d").getImageData(x, y, 1, 1).data.slice(0, 3)];
        }""", [int(at[0]), int(at[1]), len(maps.mask)]), dtype=float)

    opened.get_by_label("Layer", exact=True).first.select_option("normal")
    opened.get_by_label("Hatch unsure pixels").uncheck()
    opened.get_by_label("Rows and columns").uncheck()
    drawn(opened)
    before = [colour(at) for at in (surest, least)]
    opened.get_by_label("Grey out by").select_option(by)
    opened.wait_for_function("(title) => document.querySelector(`canvas[aria-label^='Histogram of ${title}']`) !== null", arg=title)
    wanted = 128 + (before[1] - 128) * (1 - 235 / 255)
    # the tiles of the veil come one by one
    seen(opened, lambda: np.allclose(colour(least), wanted, atol=2) and np.allclose(colour(surest), before[0], atol=2), "not greyed out")
    assert f"{title} " in point_at(opened, int(least[0]), int(least[1]), len(maps.mask))
    opened.wait_for_function("(by) => location.hash.includes(`over=${by}`)", arg=by)


def test_rows_and_columns_are_numbered_along_the_edges(opened):
    ticks = "async ([first, last, shortest]) => (await import('/static/view/maps/map_axes.js')).ticks(first, last, shortest)"
    assert opened.evaluate(ticks, [0, 127, 13.2]) == [0, 20, 40, 60, 80, 100, 120]
    assert opened.evaluate(ticks, [37.5, 40.9, 0.3]) == [38, 39, 40]
    edge = """(canvas) => { const { data } = canvas.getContext('2d').getImageData(0, canvas.height - 5, canvas.width, 5);
      return data.filter((value, at) => at % 4 === 3 && value > 0).length; }"""
    opened.get_by_label("Layer", exact=True).first.select_option("normal")
    opened.wait_for_function(f"() => ({edge})(document.querySelector('canvas.map')) > 0")
    opened.get_by_label("Rows and columns").uncheck()
    opened.wait_for_function(f"() => ({edge})(document.querySelector('canvas.map')) === 0")
    expect(opened.locator(".axis").first.locator("span")).to_have_count(3)
    low, middle, high = (float(each.replace("\u2212", "-")) for each in opened.locator(".axis").first.locator("span").all_inner_texts())
    assert low < middle < high and abs(middle - (low + high) / 2) < 2e-4  # of numbers that are shown to four digits


def test_an_unsure_pixel_is_hatched_and_said(opened, maps):
    unsure = (maps.status == 15) & (maps.mask == 0)
    assert unsure.any(), "the capture was solved so that some pixels are unsure"
    row, col = (int(each[len(each) // 2]) for each in np.nonzero(unsure))
    assert "unsure" in point_at(opened, row, col, len(maps.mask))

    with_hatching = drawn(opened)
    opened.get_by_label("Hatch unsure pixels").uncheck()
    without = drawn(opened, with_hatching)
    opened.get_by_label("Hatch unsure pixels").check()
    assert drawn(opened, without) == with_hatching


def test_the_map_is_moved_by_keys(opened, maps):
    canvas = opened.locator("canvas.map")
    canvas.focus()
    for _ in range(8):
        opened.keyboard.press("+")
    opened.keyboard.press("ArrowRight")
    middle = opened.locator("output.value")
    middle.get_by_text("row ").wait_for()
    first = middle.inner_text()
    opened.keyboard.press("ArrowDown")
    opened.wait_for_function("first => document.querySelector('output.value').textContent !== first", arg=first)
    row, col = (int(each) for each in re.findall(r"row (\d+), column (\d+)", middle.inner_text())[0])
    assert row > len(maps.mask) // 2 and col > len(maps.mask) // 2
    opened.keyboard.press("0")
    assert "row" in point_at(opened, 64, 64, len(maps.mask))


def test_two_layers_are_wiped_and_the_range_of_the_histogram_changes_the_picture(opened):
    alone = drawn(opened)
    opened.get_by_label("Compare with", exact=True).first.select_option("height")
    wipe = opened.get_by_label("Where the two layers meet")
    wipe.fill("0")
    other = drawn(opened, alone)
    wipe.fill("100")
    shown_again(opened, alone)
    wipe.fill("50")
    drawn(opened, alone, other)
    said = point_at(opened, 64, 64, 128)
    assert "Normals" in said and "Height" in said
    opened.get_by_label("Layer", exact=True).first.select_option("height")
    before = drawn(opened, alone)
    opened.get_by_label("Lowest value that is shown").fill("600")
    drawn(opened, before)


def test_the_readings_of_a_pixel_are_plotted(opened, solved, maps):
    """A click plots a point for each light and channel; the table has the numbers, which are those of the photographs."""
    row, col = 64, 64
    point_at(opened, row, col, len(maps.mask))
    opened.mouse.down()
    opened.mouse.up()
    opened.get_by_role("heading", name=f"Row {row}, column {col}").wait_for()
    capture = Capture.open(SAMPLES / "lambert")
    frames = capture.manifest.frames
    expect(opened.locator("svg.plot circle.measured")).to_have_count(3 * len(frames))
    expect(opened.locator("svg.plot polyline.model")).to_have_count(3)
    opened.locator("summary", has_text="The numbers").click()
    expect(opened.locator("section table tbody tr").last).to_be_visible()
    rows = [each.split("\t") for each in opened.locator("section table tbody tr").all_inner_texts()]
    assert [each[0] for each in rows] == [frame.image for frame in frames]
    readings = np.array([[float(value) for value in each[2].split(",")] for each in rows])
    expected = np.stack([Correction.of(capture).apply(frame).pixels[row, col] for frame in frames])
    assert np.allclose(readings, expected, rtol=2e-3, atol=1e-5)  # half floats, four digits


def test_every_map_of_the_capture_is_shown(opened):
    """Each layer has tiles, a histogram or a legend unless it is the mask, and a value under the cursor."""
    layers = opened.get_by_label("Layer", exact=True).first
    names = layers.locator("option").evaluate_all("all => all.map(each => each.value)")
    assert {"normal", "diffuse_albedo", "height", "confidence", "status", "mask"} <= set(names)
    pictures: list[str] = []
    for name in names:
        layers.select_option(name)
        pictures.append(drawn(opened, *pictures))  # each is another
        if name != "mask":  # of two values
            expect(opened.locator(".histogram canvas, .histogram li").first).to_be_visible()
        assert "row 64, column 64" in point_at(opened, 64, 64, 128)
        opened.mouse.move(5, 5)


def test_a_link_shows_the_part_of_a_map_that_its_sender_saw_and_fingers_zoom_it(page, solved):
    solved.open(page, "maps")
    spread_fingers(page.locator("canvas.map"))
    page.wait_for_function("() => location.hash.includes('map-zoom=2')")  # fingers twice as far apart
    page.locator("canvas.map").focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_function("() => location.hash.includes('map-centre=') && !location.hash.includes('map-centre=64')")
    read = "() => document.querySelector('.value').textContent.split(':')[0]"
    column = "Math.floor(location.hash.match(/map-centre=([\\d.]+)/)[1])"  # of the middle, and no longer that of a finger
    page.wait_for_function(f"() => document.querySelector('.value').textContent.includes(`column ${{{column}}}:`)")
    before = page.evaluate(read)
    page.reload()
    solved.wait_for_content(page, "maps")
    box = page.locator("canvas.map").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_function(f"(before) => ({read})() === before", arg=before)
    page.locator("canvas.map").press("0")
    page.wait_for_function("() => !location.hash.includes('map-')")
