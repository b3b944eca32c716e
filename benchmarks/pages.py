"""How soon the pages paint, how much they load, and how fast objects are relit, in headless Chromium on loopback.

python -m benchmarks.pages

Chromium renders WebGL on the processor here (SwiftShader); times are those of this machine, and the rate of frames is a lower bound of what
a graphics card shows.
"""

import os
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from benchmarks.clients import installed
from tests.service.server.pages.conftest import ARGUMENTS
from tests.service.server_process import serving

SAMPLES = Path(__file__).parents[1] / "samples"
SHOWN = {"/": ".card canvas", "/captures": "#captures a", "captures": "#frames canvas", "/jobs": "#jobs tbody a",
         "jobs": "#stages tbody tr",
         "light": "canvas.picture[data-ready]", "object": "canvas.picture[data-ready]", "maps": "canvas.map"}
"""What a page is opened for, by its address or the first word of it."""
PAINT = "() => performance.getEntriesByName('first-contentful-paint')[0].startTime"
FRAMES = 20
RATE = """frames => {
  const began = performance.now();
  for (let i = 0; i < frames; i++) relit.pixels();
  return frames * 1000 / (performance.now() - began);
}"""
SIZE = "() => { const { width, height } = document.querySelector('.picture'); return `${width} × ${height}`; }"


def main() -> int:
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright, serving(
            Path(folder), "--anonymous", "--device", "cpu", roots=str(SAMPLES), min_free_bytes="0") as server, server.client() as client:
        browser = playwright.chromium.launch(executable_path=installed.browser(), args=ARGUMENTS)
        capture = client.post("/v1/captures", json={"name": "owl", "folder": str(SAMPLES / "owl")}).raise_for_status().json()["id"]
        server.wait(client, f"/v1/captures/{capture}", ("ready",))
        done = {}
        for kind, request in {"solve": {"options": {"method": "robust"}}, "view": {}, "maps": {"kind": "view"}}.items():
            wanted = {"kind": kind, "capture": capture, **request, **({"maps": done["solve"]} if kind == "maps" else {})}
            done[kind] = client.post("/v1/jobs", json=wanted).raise_for_status().json()["id"]
            server.wait(client, f"/v1/jobs/{done[kind]}", ("succeeded",), timeout_s=600)
        print("| page | first contentful paint, ms | what it is opened for, ms | loaded without data, kB |\n|---|---:|---:|---:|")
        for path in ("/captures", "/", f"/captures/{capture}", "/jobs", f"/jobs/{done['solve']}", f"/light/{capture}", f"/object/{capture}",
                     f"/maps/{done['solve']}"):
            page = browser.new_page(base_url=server.url)
            loaded = _counted(page)
            page.goto(path)
            page.locator(SHOWN.get(path) or SHOWN[path.split("/")[1]]).first.wait_for()
            shown = page.evaluate("performance.now()")
            name = path.replace(capture, "ID").replace(done["solve"], "ID")
            print(f"| `{name}` | {page.evaluate(PAINT):.0f} | {shown:.0f} | {sum(loaded) / 1000:.0f} |")
            if "/light/" in path:
                rate, size = page.evaluate(RATE, FRAMES), page.evaluate(SIZE)
                print(f"\nlive relighting on the processor ({os.cpu_count()} cores): {rate:.1f} frames a second at {size}")
            page.close()
        browser.close()
    return 0


def _counted(page: Page) -> list[int]:
    """Return a list that gets the size of every answer that is not of the API."""
    sizes: list[int] = []
    page.on("response", lambda answer: sizes.append(len(answer.body())) if "/v1/" not in answer.url else None)
    return sizes


if __name__ == "__main__":
    sys.exit(main())
