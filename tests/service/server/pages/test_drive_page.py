"""The page of a drive shows the levels of cues.json, frame by frame, and gives the files away."""

import json

import pytest

from stage.transforms import fibonacci_sphere
from tests.scenes.rigs import write_rig
from tests.service.server.pages.axe import assert_accessible
from tests.service.server.pages.conftest import PICTURES, done, expect, seen

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def driven(server, client, sky, tmp_path_factory) -> str:
    """The job that drove a dome of 64 lamps under the turning environment of the sample."""
    rig = write_rig(tmp_path_factory.mktemp("rig") / "dome.json", fibonacci_sphere(64), irradiance=4.0)
    return done(server, client, {"kind": "drive", "rig": rig, "environment": sky,
                                 "options": {"frames": "11-14", "spin_degrees": 360.0, "auto_exposure": True}})


def shown(page) -> dict[str, list[float]]:
    """The levels in percent that the diagram says of each lamp."""
    titles = [text.split(": ") for text in page.locator("#dome title").all_text_contents()]
    return {name: [float(level.removesuffix(" %")) for level in levels.split(", ")] for name, levels in titles}


def test_the_lamps_of_each_frame_and_the_files(page, client, driven, tmp_path):
    cues = client.get(f"/v1/jobs/{driven}/results/cues.json").raise_for_status()
    page.goto(f"/jobs/{driven}")
    page.locator("#cues").click()
    page.get_by_role("heading", name="Drive of dome").wait_for()
    slider, fills = page.get_by_label("Frame"), []
    for place, frame in enumerate(cues.json()["frames"]):
        slider.fill(str(place))
        page.locator("#frame", has_text=f"{11 + place}: the brightest primary").wait_for()
        wanted: dict[str, list[float]] = {}
        for (lamp, _), level in zip(cues.json()["emitters"], frame["levels"], strict=True):
            wanted.setdefault(lamp, []).append(100 * level)
        assert shown(page) == {lamp: pytest.approx(levels, abs=0.0501) for lamp, levels in wanted.items()}  # one decimal is shown
        fills.append(page.locator("#dome circle[fill]").evaluate_all("all => all.map((each) => each.getAttribute('fill'))"))
    assert len({tuple(each) for each in fills}) == 4
    assert any("255" in fill for each in fills for fill in each)  # the brightest of all frames
    page.wait_for_function("document.getElementById('picture').naturalWidth > 0")
    with page.expect_download() as saved:
        page.get_by_role("button", name="Download cues.json").click()
    assert json.loads(saved.value.path().read_text()) == cues.json()
    page.screenshot(path=f"{PICTURES or tmp_path}/page_drive.png")


def test_balls_the_environment_and_the_object_follow_the_slider(page, driven, solved):
    page.goto(f"/drive/{driven}")
    page.get_by_label("Object", exact=True).select_option(solved.capture)
    page.locator("#picture-of-object canvas[data-ready]").wait_for(timeout=120_000)
    canvases = page.locator("#environment canvas, #balls canvas, #picture-of-object canvas")
    expect(canvases).to_have_count(4)

    def pictures(place: str) -> list[str]:
        page.get_by_label("Frame").fill(place)
        return canvases.evaluate_all("found => found.map((canvas) => canvas.toDataURL())")

    first = pictures("0")
    seen(page, lambda: all(one != other for one, other in zip(first, pictures("2"), strict=True)))


def test_a_job_of_another_kind_is_said(page, solved):
    page.goto(f"/drive/{solved.solve}")
    page.locator("#state", has_text="This job drives no rig.").wait_for()


def test_the_page_fits_and_has_no_violation(open_to_axe, driven):
    open_to_axe.goto(f"/drive/{driven}")
    open_to_axe.locator("#dome circle[fill]").first.wait_for()
    assert_accessible(open_to_axe, 1280, 390)
