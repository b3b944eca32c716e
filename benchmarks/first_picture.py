"""How soon the page of relit publish --as web shows its picture on a line of 10 Mbit/s, in headless Chromium.

python -m benchmarks.first_picture

It prints a table of docs/publish.md. Chromium holds answers back as the line would (DevTools protocol,
Network.emulateNetworkConditions); each load has an empty cache.
"""

import json
import statistics
import sys
import tempfile
import threading
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, sync_playwright

from benchmarks.clients import installed
from service.publish.publish import publish
from service.requests.publish import PublishRequest
from tests.scenes.captures import rgb, write_exr, write_image
from tests.service.publish.published import image
from tests.service.server.pages.conftest import ARGUMENTS
from tests.service.server.pages.test_published_page import Files

OWL = Path(__file__).parents[1] / "samples" / "owl"
LINE = {"offline": False, "latency": 40, "downloadThroughput": 10e6 / 8, "uploadThroughput": 10e6 / 8}
"""10 Mbit/s, and 40 ms to and fro as of a server in the same part of the world."""
LOADS = 5
WATCH = """new MutationObserver(() => {
  const ready = document.getElementById("picture")?.dataset.ready;
  if (ready !== undefined) (globalThis.seen ??= {})[ready] ??= performance.now();
}).observe(document, { subtree: true, attributes: true, attributeFilter: ["data-ready"] });"""


def repeated(folder: Path, times: int) -> Path:
    """Write a capture in which the owl stands `times` by `times` times, so that all of the picture has its detail."""
    manifest = json.loads((OWL / "capture.json").read_text())
    for frame in manifest["frames"]:
        write_exr(folder / frame["image"], np.tile(rgb(OWL / frame["image"]), (times, times, 1)), np.float16)
    write_image(folder / manifest["mask"], np.tile(image(OWL / manifest["mask"])[..., 0], (times, times)))
    manifest["camera"]["resolution"] = [times * side for side in manifest["camera"]["resolution"]]
    (folder / "capture.json").write_text(json.dumps(manifest))
    return folder


def load(browser: Browser, address: str) -> tuple[float, float, int]:
    """Return seconds until the first picture and until the sharp one, and the bytes that were sent."""
    context = browser.new_context(viewport={"width": 1200, "height": 800}, bypass_csp=True)
    page = context.new_page()
    page.add_init_script(WATCH)
    context.new_cdp_session(page).send("Network.emulateNetworkConditions", LINE)
    Files.sent = 0
    page.goto(address)
    page.locator("#picture[data-ready='whole']").wait_for()
    seen = page.evaluate("globalThis.seen")
    context.close()
    return min(seen.values()) / 1000, seen["whole"] / 1000, Files.sent


def main() -> int:
    print("| page | first picture | sharp | loaded |\n|---|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=installed.browser(), args=ARGUMENTS)
        for times in (1, 8):
            folder = Path(name) / str(times)
            folder.mkdir()
            publish(PublishRequest(capture=repeated(folder, times), out=folder / "page", kind="web", cache=folder / "cache"))
            with ThreadingHTTPServer(("127.0.0.1", 0), partial(Files, directory=folder / "page")) as server:
                threading.Thread(target=server.serve_forever, daemon=True).start()
                loads = [load(browser, f"http://127.0.0.1:{server.server_port}/") for _ in range(LOADS)]
                server.shutdown()
            first, sharp, sent = (statistics.median(each) for each in zip(*loads, strict=True))
            print(f"| {320 * times} x {320 * times} pixels | {first:.1f} s | {sharp:.1f} s | {sent / 1e6:.2f} MB |")
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
