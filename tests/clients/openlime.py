"""A published folder in OpenLIME itself, by the page of docs/publish.md, in headless Chromium, from a plain server of files.

OpenLIME is free software of ISTI-CNR and CRS4 (GPL-3), the package `openlime` of npm; nothing of it is part of Relit.
"""

import base64
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.clients import installed
from tests.service.publish.published import served
from tests.service.server.pages.conftest import new_context

DOCUMENTED = Path(__file__).parents[2] / "docs" / "publish.md"
HELPERS = """
window.loaded = () => {
  const tiles = [...layer.tiles.values()];
  return tiles.every((tile) => tile.missing === 0) && !layer.queue.length && tiles.length;
};
window.scale = () => viewer.camera.viewport && viewer.camera.getGlCurrentTransform(performance.now()).z;
window.picture = (x, y) => {
  layer.setLight([x, y], 0);
  viewer.canvas.draw(performance.now());
  return viewer.canvasElement.toDataURL("image/png").split(",")[1];
};
</script>"""
"""What the tests ask of the page, in its own script."""


class Shown:
    """OpenLIME with a published folder."""

    def __init__(self, page: Any) -> None:
        self._page = page

    @property
    def tiles(self) -> int:
        """How many tiles it has loaded."""
        return int(self._page.evaluate("loaded()"))

    def pictures(self, directions: np.ndarray) -> np.ndarray:
        """[n, rows, cols, 3] what its canvas shows under lights from `directions` [n, 3], 0 to 1."""
        found = []
        for x, y in directions[:, :2].tolist():
            data = base64.b64decode(self._page.evaluate("([x, y]) => picture(x, y)", [x, y]))
            found.append(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255)
        return np.array(found)


@contextmanager
def opened(browser: Any, folder: Path, layout: str, *, size: tuple[int, int], scale: float) -> Iterator[Shown]:
    """Open the folder `owl-planes` in `folder`, with images of `size`, columns and rows, in the layout of OpenLIME, in a window that is
    `scale` times as large as they are."""
    package = installed.openlime()
    [documented] = re.findall(r"```html\n(<div id=\"view\".*?)```", DOCUMENTED.read_text(), re.DOTALL)
    body = "<!doctype html>" + documented.replace('layout: "deepzoom"', f'layout: "{layout}"').replace("</script>", HELPERS)
    context = new_context(browser, viewport={"width": int(size[0] * scale), "height": int(size[1] * scale)}, device_scale_factor=1)
    page, errors = context.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.route("**/favicon.ico", lambda route: route.fulfill(status=204))
    page.route("**/viewer.html", lambda route: route.fulfill(content_type="text/html", body=body))
    page.route("**/openlime.esm.js", lambda route: route.fulfill(content_type="text/javascript", body=package.read_text()))
    with served(folder) as address:
        page.goto(f"{address}viewer.html")
        page.wait_for_function("scale => loaded() && window.scale() === scale", arg=scale)
        yield Shown(page)
        context.close()
    assert errors == []
