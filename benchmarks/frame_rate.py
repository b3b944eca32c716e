"""How many pictures a second live relighting draws in a browser: run it on the machine whose graphics card is of interest.

python -m benchmarks.frame_rate [--browser PATH] [--side 1024] [--layers 32] [--software]

Opens Chromium or Chrome with the renderer of the pages, fills it with random numbers of the size of a capture, and draws with new
coefficients every time, as when an environment turns. A picture counts when its pixels can be read. `--software` renders on the processor
(SwiftShader).
"""

import argparse
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from playwright.sync_api import sync_playwright

from benchmarks.clients import installed

STATIC = Path(__file__).parents[1] / "service" / "server" / "pages" / "static"
SOFTWARE = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PAGE = b"<!doctype html><title>frame rate</title><canvas></canvas>"
LIGHTS = 96
MOST_TILES = 1024
DRAW = """async ({ side, layers, lights, mostTiles, seconds }) => {
  const { BasisRenderer } = await import('/view/light/basis_renderer.js');
  const { addWeighted } = await import('/view/light/light_model.js');
  let tile = 8;
  while (Math.ceil(side / tile) ** 2 > mostTiles) tile *= 2;
  const across = Math.ceil(side / tile);
  const count = across ** 2;
  const canvas = document.querySelector('canvas');
  [canvas.width, canvas.height] = [side, side];
  const relight = { rows: side, cols: side, terms: layers, tiles: { side: tile, rows: across, cols: across, count } };
  const renderer = new BasisRenderer(canvas, relight, 'lin_rec709_scene');
  renderer.setTiles(Uint16Array.from({ length: count }, (_, index) => index));
  const random = Uint16Array.from({ length: 3 * side * side }, () => 0x2800 + Math.floor(0x800 * Math.random())); // halves 0.03 to 0.13
  for (let term = 0; term < layers; term += 1) await renderer.setTerm(term, random);
  renderer.setMatte(new Uint8Array(side * side).fill(255));
  const each = 3 * layers * count;
  const captured = Float32Array.from({ length: lights * each }, () => Math.random() / lights / layers);
  const gl = canvas.getContext('webgl2');
  const pixel = new Uint8Array(4);
  const picture = () => {
    const began = performance.now();
    const shown = new Float32Array(each);
    for (let light = 0; light < lights; light += 1) {
      addWeighted(shown, captured.subarray(light * each, (light + 1) * each), [Math.random(), Math.random(), Math.random()]);
    }
    const summed = performance.now();
    renderer.draw({ shown, compared: null, border: 1, gain: 1, backdrop: [0, 0, 0] });
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    return [summed - began, performance.now() - began];
  };
  for (let warm = 0; warm < 3; warm += 1) picture();
  const taken = [];
  const began = performance.now();
  while (performance.now() - began < 1000 * seconds || taken.length < 5) {
    taken.push(picture());
    await new Promise((done) => { setTimeout(done); });
  }
  const { DrawLoop } = await import('/view/light/draw_loop.js');
  const tasks = [0];
  new PerformanceObserver((list) => tasks.push(...list.getEntries().map(({ duration }) => duration))).observe({ type: 'longtask' });
  const strides = [];
  const loop = new DrawLoop(renderer, (stride) => strides.push(stride));
  const shown = captured.subarray(0, each);
  const move = async (for_s) => {
    strides.length = 0;
    const since = performance.now();
    while (performance.now() - since < 1000 * for_s) {
      loop.ask({ shown, compared: null, border: 1, gain: 1, backdrop: [0, 0, 0] });
      await new Promise(requestAnimationFrame);
    }
    return strides.length / for_s;
  };
  await move(2); // it learns how fast the machine is
  const movingRate = await move(seconds);
  const stride = strides.toSorted((a, b) => a - b)[Math.floor(strides.length / 2)];
  const still = performance.now();
  await loop.settled();
  const sharpMs = performance.now() - still;
  const longestMs = Math.max(...tasks);
  const median = (at) => taken.map((times) => times[at]).sort((a, b) => a - b)[Math.floor(taken.length / 2)];
  const info = gl.getExtension('WEBGL_debug_renderer_info');
  return { card: info === null ? 'unknown' : gl.getParameter(info.UNMASKED_RENDERER_WEBGL), pictures: taken.length,
    movingRate, stride, sharpMs, longestMs, sumMs: median(0), wholeMs: median(1),
    gpuMs: renderer.timer.figures().gpuMs, lit: pixel[0] > 0 };
}"""


class Handler(SimpleHTTPRequestHandler):
    """Serves an empty page and the modules of the pages."""

    def do_GET(self) -> None:
        if self.path != "/":
            return super().do_GET()
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(PAGE)
        return None

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--browser", help="Chromium or Chrome; without it, the one that the tests use")
    parser.add_argument("--side", type=int, default=1024, help="rows and columns of the picture")
    parser.add_argument("--layers", type=int, default=32, help="coefficient images")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long to draw")
    parser.add_argument("--software", action="store_true", help="render on the processor, without a window")
    given = parser.parse_args()
    print("\n".join(frame_rate(given.browser, side=given.side, layers=given.layers, seconds=given.seconds, software=given.software)))
    return 0


def frame_rate(browser: str | None, *, side: int, layers: int, seconds: float, software: bool) -> list[str]:
    """Return what was measured, in lines for people."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(STATIC)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with sync_playwright() as playwright:
            running = playwright.chromium.launch(executable_path=browser or installed.browser(), headless=software,
                                                 args=["--no-sandbox", *(SOFTWARE if software else ["--ignore-gpu-blocklist"])])
            page = running.new_page()
            page.goto(f"http://127.0.0.1:{server.server_address[1]}/")
            found = page.evaluate(DRAW, {"side": side, "layers": layers, "lights": LIGHTS, "mostTiles": MOST_TILES, "seconds": seconds})
            running.close()
    finally:
        server.shutdown()
        server.server_close()
    assert found["lit"], "the picture is black"
    rate, read = 1000 / found["wholeMs"], 8 * layers * side**2
    gpu = "not told by this browser" if found["gpuMs"] is None else f"{found['gpuMs']:.2f} ms"
    return [f"graphics       {found['card']}",
            f"picture        {side} x {side} ({side**2 / 1e6:.2f} megapixels), {layers} coefficient images, {read / 1e6:.0f} MB read",
            f"pictures       {found['pictures']}, median of their times:",
            f"whole picture  {found['wholeMs']:.1f} ms: {rate:.1f} pictures a second, {rate * read / 1e9:.2f} GB/s",
            f"of it          {found['sumMs']:.1f} ms for the coefficients of {LIGHTS} lights on the processor; graphics card {gpu}",
            f"moving         {found['movingRate']:.1f} pictures a second as the page draws them, one of {found['stride']} pixels in a row; "
            f"longest task {found['longestMs']:.0f} ms",
            f"still          the whole picture {found['sharpMs'] / 1000:.2f} s after the last move"]


if __name__ == "__main__":
    sys.exit(main())
