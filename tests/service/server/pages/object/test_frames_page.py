"""Relit frames on the page of their object: pictures that the server makes, a player, a video, and the files."""

import io

import numpy as np
import OpenImageIO as oiio
import pytest

from stage.formats import exr
from tests.service.server.api.job_calls import refused
from tests.service.server.pages.conftest import done
from tests.service.server.pages.frames import encoded

pytestmark = pytest.mark.long

FRAMES = 12
MOST_OPEN = 4
"""Pictures that are decoded at one time: three that come, and one that is shown."""
COUNT_BITMAPS = """globalThis.openBitmaps = globalThis.mostOpen = 0;
const decode = createImageBitmap, close = ImageBitmap.prototype.close;
globalThis.createImageBitmap = async (...given) => {
  const bitmap = await decode(...given);
  mostOpen = Math.max(mostOpen, ++openBitmaps);
  return bitmap;
};
ImageBitmap.prototype.close = function () { openBitmaps -= 1; close.call(this); };"""


@pytest.fixture(scope="module")
def relit(server, solved, sky) -> str:
    with server.client() as client:
        return done(server, client, {"kind": "relight", "capture": solved.capture, "environment": sky,
                                     "name": "<img src=x onerror=alert(1)>", "options": {"frames": f"1-{FRAMES}", "spin_degrees": 90}})


def test_the_picture_of_a_frame_is_the_frame_as_a_screen_shows_it(server, solved, relit, tmp_path):
    with server.client() as client:
        answer = client.get(f"/v1/jobs/{relit}/pictures/frame.0001.exr").raise_for_status()
        assert client.get(f"/v1/jobs/{relit}/pictures/frame.0001.exr", headers={"If-None-Match": answer.headers["ETag"]}).status_code == 304
        refused(client.get(f"/v1/jobs/{solved.solve}/pictures/report.json"), 422, "report.json is no EXR file")
        refused(client.get(f"/v1/jobs/{relit}/pictures/frame.9.exr"), 404, "has no such result")
    assert answer.headers["Content-Type"] == "image/jpeg"
    (tmp_path / "frame.jpg").write_bytes(io.BytesIO(answer.content).getvalue())
    shown = oiio.ImageBuf(str(tmp_path / "frame.jpg")).get_pixels(oiio.FLOAT)
    channels, _ = exr.read(solved.result(relit, "frame.0001.exr", tmp_path))
    expected = encoded(np.stack([channels[each] for each in "RGB"], axis=-1).astype(np.float32)) + 0.2 * (1 - channels["A"][..., None])
    assert shown.shape == expected.shape
    assert np.abs(shown - expected).mean() < 0.02  # JPEG, whose colour has half of the resolution


def test_frames_are_played_recorded_and_saved(page, solved, relit):
    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    page.add_init_script(COUNT_BITMAPS)
    page.goto(f"{solved.pages['object']}#mode=frames")
    page.locator("[data-shows=frames] canvas[data-ready]").wait_for()
    assert page.locator(".filmstrip li").count() == FRAMES
    assert page.locator("[data-shows=frames] img").count() == 0
    assert "<img" in page.get_by_label("Frames of").locator("option").first.inner_text()
    look = """() => document.querySelector('.frames-picture').getContext('2d').getImageData(0, 0, 128, 128).data
      .reduce((sum, each, at) => sum + each * (at % 97), 0)"""
    first = page.evaluate(look)
    page.get_by_role("button", name="Frame 3").click()
    page.get_by_text(f"frame.0003.exr (3 of {FRAMES})").wait_for()
    assert page.evaluate(look) != first
    page.get_by_role("button", name="Play").click()
    page.get_by_text(f"frame.0002.exr (2 of {FRAMES})").wait_for()  # after the last comes the first
    page.get_by_role("button", name="Play").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save a video").click()
    assert download.value.path().read_bytes()[:4] == b"\x1aE\xdf\xa3"  # EBML, of which WebM is made
    page.wait_for_function("() => openBitmaps === 0")
    assert 0 < page.evaluate("() => mostOpen") <= MOST_OPEN
    page.get_by_text(f"All {FRAMES} frames as EXR").click()
    with page.expect_download() as download:
        page.get_by_role("link", name="frame.0002.exr").click()
    assert download.value.path().read_bytes()[:4] == b"\x76\x2f\x31\x01"
