"""How soon the pages paint and show what they are opened for, and how long they hold their user up, in headless Chromium on loopback.

python -m benchmarks.pages [--large 3,11]

Chromium renders WebGL on the processor here (SwiftShader). Times are those of this machine and of what else runs on it: the load average is
printed beside them. It prints a table of docs/pages.md.
"""

import argparse
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks.clients import installed
from benchmarks.first_picture import repeated
from tests.service.server.pages.conftest import ARGUMENTS
from tests.service.server.pages.object.test_motion import SHIFTS
from tests.service.server_process import serving

SAMPLES = Path(__file__).parents[1] / "samples"
LOADS = 3
SHOWN = {"/": ".card canvas", "captures": "#captures a", "jobs": "#jobs tbody a", "machines": "#audit tbody tr",
         "capture": "#frames canvas", "job": "#stages tbody tr", "light": "canvas.picture[data-shown]",
         "object": "canvas.picture[data-shown]", "maps": "canvas.map",
         "asset": "canvas.scene[data-shown]"}
"""What a page is opened for; of the light and of 3-D a first picture, which may be the server's."""
WHOLE = {"asset": "canvas.scene[data-share]"}
"""What is on a page last, where it comes after all that the page waits for."""
TASKS = """globalThis.tasks = [];
new PerformanceObserver((list) => tasks.push(...list.getEntries().map(({ duration }) => duration)))
  .observe({ type: "longtask", buffered: true });"""
MOVE = """async (seconds) => {
  document.querySelector("canvas.picture[data-ready]").focus();
  tasks.length = 0;
  let [pictures, waits, last] = [0, [], performance.now()];
  const seen = new MutationObserver(() => { pictures += 1; });
  seen.observe(document.querySelector("canvas.picture"), { attributes: true, attributeFilter: ["data-stride"] });
  const began = performance.now();
  for (let at = 0; performance.now() - began < 1000 * seconds; at += 1) {
    relit.set([0.4 * Math.cos(at / 9), 0.4 * Math.sin(at / 9), 0.8]);
    await new Promise(requestAnimationFrame);
    waits.push(performance.now() - last);
    last = performance.now();
  }
  const taken = (performance.now() - began) / 1000;
  const stride = document.querySelector("canvas.picture").dataset.stride;
  const still = performance.now();
  await relit.settled();
  seen.disconnect();
  return { rate: pictures / taken, stride, longest: Math.max(0, ...tasks), wait: Math.max(...waits), sharp: performance.now() - still };
}"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--large", default="3,11",
                        help="how often the owl stands in a row and a column of larger captures: 1 and 12 megapixels")
    large_captures = [int(each) for each in parser.parse_args().large.split(",")]
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright, serving(
            Path(folder) / "data", "--anonymous", "--device", "cpu", roots=os.pathsep.join([str(SAMPLES), f"{folder}/captures"]),
            min_free_bytes="0") as server, server.client() as client:
        browser = playwright.chromium.launch(executable_path=installed.browser(), args=ARGUMENTS)

        def registered(path: Path) -> str:
            found = client.post("/v1/captures", json={"name": path.name, "folder": str(path)}).raise_for_status().json()["id"]
            return str(server.wait(client, f"/v1/captures/{found}", ("ready",))["id"])

        def done(**wanted: object) -> str:
            found = client.post("/v1/jobs", json=wanted).raise_for_status().json()["id"]
            return str(server.wait(client, f"/v1/jobs/{found}", ("succeeded",), timeout_s=1800)["id"])

        owl = registered(SAMPLES / "owl")
        solved = done(kind="solve", capture=owl, options={"method": "robust"})
        for maps in ({"maps": solved}, {}):
            done(kind="view", capture=owl, **maps)
        asset = done(kind="export", maps=solved, rig=owl)
        places = {"/": "/", "captures": "/captures", "jobs": "/jobs", "machines": "/machines", "capture": f"/captures/{owl}",
                  "job": f"/jobs/{solved}", "light": f"/light/{owl}", "object": f"/object/{owl}", "maps": f"/maps/{solved}",
                  "asset": f"/asset/{asset}"}
        print("| page | first paint, ms | what it is opened for, ms | all of it, ms | longest task, ms | layout shift |",
              "loaded without data, kB |")
        print("|---|---:|---:|---:|---:|---:|---:|")
        for name, path in places.items():
            _print_loads(browser, server.url, name, path)
        for times in large_captures:
            large = Path(folder) / "captures" / f"owl{times}"
            large.mkdir(parents=True)
            capture = registered(repeated(large, times))
            done(kind="view", capture=capture)
            _print_loads(browser, server.url, "light", f"/light/{capture}", f"light, {(320 * times) ** 2 / 1e6:.0f} megapixels")
            _print_motion(browser, server.url, capture)
        print(f"\n{os.cpu_count()} cores, load average {os.getloadavg()[1]:.1f} over five minutes")
        browser.close()
    return 0


def _print_loads(browser: Browser, url: str, name: str, path: str, words: str = "") -> None:
    """Print medians of some loads of a page, each with an empty cache."""
    found: list[dict[str, Any]] = []
    for _ in range(LOADS):
        context = browser.new_context(base_url=url, viewport={"width": 1280, "height": 860})
        context.add_init_script(SHIFTS + TASKS)
        page = context.new_page()
        page.set_default_timeout(300_000)
        loaded = _counted(page)
        page.goto(path)
        page.locator(SHOWN[name]).first.wait_for()
        shown = page.evaluate("performance.now()")
        page.wait_for_function("() => !document.querySelector('main').hasAttribute('aria-busy')")
        if name in WHOLE:
            page.locator(WHOLE[name]).first.wait_for()
        whole = page.evaluate("performance.now()")
        found.append({"paint": page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime"),
                      "shown": shown, "whole": whole, "task": page.evaluate("Math.max(0, ...tasks)"),
                      "shift": page.evaluate("shifts.reduce((sum, [value]) => sum + value, 0)"),
                      "size": sum(loaded) / 1000})
        context.close()
    paint, shown, whole, task, shift, size = (statistics.median(each[key] for each in found)
                                             for key in ("paint", "shown", "whole", "task", "shift", "size"))
    print(f"| {words or f'`{name}`'} | {paint:.0f} | {shown:.0f} | {whole:.0f} | {task:.0f} | {shift:.4f} | {size:.0f} |", flush=True)


def _print_motion(browser: Browser, url: str, capture: str) -> None:
    """Print how a light that moves is followed."""
    page = browser.new_page(base_url=url, viewport={"width": 1280, "height": 860})
    page.set_default_timeout(300_000)
    page.add_init_script(TASKS)
    page.goto(f"/light/{capture}")
    page.locator("canvas.picture[data-ready]").wait_for()
    page.evaluate(MOVE, 2)  # the page learns how fast the machine is
    told = page.evaluate(MOVE, 6)
    print(f"\nmoving: {told['rate']:.1f} pictures a second, one of {told['stride']} pixels in a row; longest task "
          f"{told['longest']:.0f} ms, longest time between two frames of the page {told['wait']:.0f} ms; "
          f"whole {told['sharp'] / 1000:.2f} s after the last move\n",
          flush=True)
    page.close()


def _counted(page: Page) -> list[int]:
    """Return a list that gets the size of every answer that is not of the API."""
    sizes: list[int] = []
    page.on("response", lambda answer: sizes.append(len(answer.body())) if "/v1/" not in answer.url and answer.status == 200 else None)
    return sizes


if __name__ == "__main__":
    sys.exit(main())
