"""Pictures of the page that relights live beside frames of the batch that it submits."""

import base64
from pathlib import Path

import numpy as np

from stage.colour.colour import rgb_matrix
from stage.formats import exr
from tests.reference.colour import srgb
from tests.service.server.pages.conftest import Solved

STEPS = 2 / 255
"""Largest mean difference of the picture in the browser from the frame: that of the issue."""


def pixels(page, source: str) -> np.ndarray:
    """[n, 4] uint8 the pixels that an expression of the page gives; as text, since Playwright takes a long time over lists of numbers."""
    text = page.evaluate(f"""async () => {{
      const reader = new FileReader();
      reader.readAsDataURL(new Blob([{source}]));
      await new Promise((done) => {{ reader.onload = done; }});
      return reader.result;
    }}""")
    return np.frombuffer(base64.b64decode(text.partition(",")[2]), dtype=np.uint8).reshape(-1, 4)


def picture(page) -> np.ndarray:
    """What is shown of a square capture, [rows, cols, 3], 0 to 1."""
    page.wait_for_function("() => globalThis.relit !== undefined")  # a moment after the canvas is ready
    found = pixels(page, "relit.pixels()")
    side = round(len(found) ** 0.5)
    return (found.reshape(side, side, 4)[..., :3] / 255).astype(np.float64)


def rendered(page, solved: Solved, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The first frame of the batch that the page submits, encoded as the page does, and its coverage."""
    page.get_by_label("Frames", exact=True).last.fill("1")
    page.get_by_role("button", name="Render").click()
    page.wait_for_url("**/jobs/job_*")
    page.locator(".state.succeeded").wait_for(timeout=120_000)
    job = page.url.rpartition("/")[2]
    channels, metadata = exr.read(solved.result(job, "frame.0001.exr", folder))
    to_screen = rgb_matrix(exr.color_space_of(metadata), "lin_rec709_scene")
    return srgb(np.stack([channels[c] for c in "RGB"], axis=-1).astype(np.float32) @ to_screen.T), channels["A"]


def assert_same(shown: np.ndarray, frame: np.ndarray, coverage: np.ndarray) -> None:
    inside = coverage == 1
    assert inside.sum() > 1000 and frame[inside].mean() > 0.1
    assert np.abs(shown[inside] - frame[inside]).mean() <= STEPS
