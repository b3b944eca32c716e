"""Relit frames on the page of their object: pictures that the server makes, a player, a video, and the files."""

import io
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from stage.formats import exr
from tests.reference.colour import srgb
from tests.service.server.api.job_calls import refused
from tests.service.server.pages.conftest import alter, done, expect

pytestmark = pytest.mark.long

FRAMES = 12
MOST_OPEN = 4
"""Pictures that are decoded at one time: three that come, and one that is shown."""
PARALLEL = 3
"""Pictures that are asked for at one time."""
LOOK = """() => document.querySelector('.frames-picture').getContext('2d').getImageData(0, 0, 128, 128).data
  .reduce((sum, each, at) => sum + each * (at % 97), 0)"""
FAIL_ONCE = """() => {
  const decode = createImageBitmap;
  globalThis.createImageBitmap = async () => { globalThis.createImageBitmap = decode; throw new Error("unreadable"); };
}"""
COUNT_BITMAPS = """globalThis.openBitmaps = globalThis.mostOpen = 0;
const decode = createImageBitmap, close = ImageBitmap.prototype.close;
globalThis.createImageBitmap = async (...given) => {
  const bitmap = await decode(...given);
  mostOpen = Math.max(mostOpen, ++openBitmaps);
  return bitmap;
};
ImageBitmap.prototype.close = function () { openBitmaps -= 1; close.call(this); };"""


@pytest.fixture(scope="module")
def relit(server, client, solved, sky) -> str:
    return done(server, client, {"kind": "relight", "capture": solved.capture, "environment": sky,
                                 "name": "<img src=x onerror=alert(1)>", "options": {"frames": f"1-{FRAMES}", "spin_degrees": 90}})


def last_frame_of(video: Path, client, job: str) -> int:
    """The number of the frame that is most like the last picture of a video."""
    recording, last = cv2.VideoCapture(str(video)), None
    while (read := recording.read())[0]:
        last = read[1].astype(np.float32)
    names = [f"/v1/jobs/{job}/pictures/frame.{number:04}.exr" for number in range(1, FRAMES + 1)]
    frames = [cv2.imdecode(np.frombuffer(client.get(name).content, np.uint8), cv2.IMREAD_COLOR) for name in names]
    return 1 + int(np.argmin([np.abs(last - frame).mean() for frame in frames]))


def test_the_picture_of_a_frame_is_the_frame_as_a_screen_shows_it(client, solved, relit, tmp_path):
    answer = client.get(f"/v1/jobs/{relit}/pictures/frame.0001.exr").raise_for_status()
    assert client.get(f"/v1/jobs/{relit}/pictures/frame.0001.exr", headers={"If-None-Match": answer.headers["ETag"]}).status_code == 304
    refused(client.get(f"/v1/jobs/{solved.solve}/pictures/report.json"), 422, "report.json is no EXR file")
    refused(client.get(f"/v1/jobs/{relit}/pictures/frame.9.exr"), 404, "has no such result")
    assert answer.headers["Content-Type"] == "image/jpeg"
    (tmp_path / "frame.jpg").write_bytes(io.BytesIO(answer.content).getvalue())
    shown = oiio.ImageBuf(str(tmp_path / "frame.jpg")).get_pixels(oiio.FLOAT)
    channels, _ = exr.read(solved.result(relit, "frame.0001.exr", tmp_path))
    expected = srgb(np.stack([channels[each] for each in "RGB"], axis=-1).astype(np.float32)) + 0.2 * (1 - channels["A"][..., None])
    assert shown.shape == expected.shape
    assert np.abs(shown - expected).mean() < 0.02  # JPEG, whose colour has half of the resolution


def test_a_picture_that_does_not_come_is_said_in_words_and_asked_for_again(page, solved, relit):
    lost = [True]

    def answer(route):
        if lost[0]:
            route.fulfill(status=404, json={"title": "gone", "detail": "<img src=x onerror=alert(1)> is gone"})
        else:
            route.continue_()

    under_way, most = set(), []

    def follow(request) -> None:
        if "/pictures/" in request.url:
            under_way.symmetric_difference_update([request])
            most.append(len(under_way))

    for event in ("request", "requestfinished", "requestfailed"):
        page.on(event, follow)
    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    page.route("**/pictures/frame.0001.exr", answer)
    page.route("**/pictures/frame.0003.exr", lambda route: route.fulfill(body=b"no picture") if lost[0] else route.continue_())
    page.goto(f"{solved.pages['object']}#mode=frames")
    page.get_by_text(f"frame.0001.exr (1 of {FRAMES}) has no picture. <img").wait_for()
    page.get_by_role("button", name="missing picture").click()  # while others are still loaded, which doubles nothing
    again = page.get_by_role("button", name="Try 2 missing pictures again")
    again.wait_for()
    expect(page.locator(".frames-picture.missing")).to_have_count(1)
    expect(page.locator(".filmstrip .icon")).to_have_count(2)
    page.get_by_role("button", name="Frame 3").click()
    page.get_by_text(f"(3 of {FRAMES}) has no picture. The browser cannot").wait_for()
    expect(page.get_by_role("button", name="Save a video")).to_have_count(0)  # a video with gaps would be no video of the frames
    lost[0] = False
    again.click()
    page.locator("[data-shows=frames] canvas[data-ready]").wait_for()
    page.get_by_text(f"frame.0003.exr (3 of {FRAMES})", exact=True).wait_for()
    expect(again).to_be_hidden()
    page.get_by_role("button", name="Save a video").wait_for()
    assert max(most) <= PARALLEL
    before = page.evaluate(LOOK)
    page.evaluate(FAIL_ONCE)
    page.evaluate("() => [4, 5].forEach((each) => document.querySelector(`[aria-label='Frame ${each}']`).click())")
    page.wait_for_function(f"(before) => ({LOOK})() !== before", arg=before)  # it is not held up by the one that cannot be read
    expect(page.locator(".filmstrip li:nth-child(4) .icon")).to_have_count(1)
    expect(page.locator(".frames-picture.missing")).to_have_count(0)


def test_what_was_taken_for_granted_is_no_warning_of_frames(page, solved, relit):
    alter(page, "**/results/view.json", lambda view: view | {"assumed": ["no lens is known"]})
    alter(page, f"**/v1/jobs/{relit}/log", lambda log: {"entries": [
        *log["entries"], {**log["entries"][-1], "text": "warning: no lens is known"}]})
    page.goto(f"{solved.pages['object']}#mode=frames")
    expect(page.locator("[data-shows=frames] .assumed li")).to_have_text(["no lens is known"])
    expect(page.locator("[data-shows=frames] .warnings")).not_to_contain_text("no lens")


def test_frames_are_played_recorded_and_saved(page, client, solved, relit):
    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    page.add_init_script(COUNT_BITMAPS)
    page.goto(f"{solved.pages['object']}#mode=frames")
    page.locator("[data-shows=frames] canvas[data-ready]").wait_for()
    expect(page.locator(".filmstrip li")).to_have_count(FRAMES)
    expect(page.locator("[data-shows=frames] img")).to_have_count(0)
    expect(page.get_by_label("Frames of").locator("option").first).to_contain_text("<img")
    log = [entry["text"] for entry in client.get(f"/v1/jobs/{relit}/log").json()["entries"]]
    warnings = [text.removeprefix("warning: ") for text in log if text.startswith("warning: ")]
    assert any("of the light of frame" in each for each in warnings)  # from where no lamp of the sample stands
    expect(page.locator("[data-shows=frames] .warnings li")).to_have_text(warnings)
    first = page.evaluate(LOOK)
    page.get_by_role("button", name="Frame 3").click()
    page.get_by_text(f"frame.0003.exr (3 of {FRAMES})").wait_for()
    page.wait_for_function(f"(first) => ({LOOK})() !== first", arg=first)  # it is decoded when it is chosen
    page.get_by_role("button", name="Play").click()
    page.wait_for_function("() => document.querySelector('.frames-bar input').value < 2")  # after the last comes the first
    page.get_by_role("button", name="Play").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save a video").click()
    assert download.value.path().read_bytes()[:4] == b"\x1aE\xdf\xa3"  # EBML, of which WebM is made
    assert last_frame_of(download.value.path(), client, relit) == FRAMES
    page.wait_for_function("() => openBitmaps === 0")
    assert 0 < page.evaluate("() => mostOpen") <= MOST_OPEN
    page.get_by_text(f"All {FRAMES} frames as EXR").click()
    with page.expect_download() as download:
        page.get_by_role("link", name="frame.0002.exr").click()
    assert download.value.path().read_bytes()[:4] == b"\x76\x2f\x31\x01"
