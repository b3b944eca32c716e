"""A server with the samples, and pages of it in headless Chromium.

Chromium is Debian's. Without it these tests are skipped, unless RELIT_TEST_PAGES is `required`, as .ci/run sets it.
"""

import io
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np
import pytest
from PIL import Image

from benchmarks.clients import installed
from service.server.base.settings import Settings
from service.server.process.connections import ConnectionLimits
from service.server.process.serve import http_server
from tests.service.server.api.asgi import app_of
from tests.service.server.api.job_calls import admitted, finish, submit
from tests.service.server_process import Server, serving
from tests.service.waiting import until

SAMPLES = Path(__file__).resolve().parents[4] / "samples"
REQUIRED = os.environ.get("RELIT_TEST_PAGES") == "required"
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking", "--disable-sync",
             "--disable-component-update", "--no-first-run", "--disable-quic", "--disable-gpu-compositing"]
"""WebGL is rendered by the processor; without the others, Chromium asks servers of its maker."""
CONTENT_MS = 60_000
"""Time for the content of a page on a loaded machine."""
PATIENCE_MS = 120_000
"""Time for what a page does at once where the processor has time, as long as WebGL is not rendered on it meanwhile."""
PAGE_BYTES = 3_000_000
"""Largest page without data, as the issue asks."""
MAX_SIGMA = 0.3
"""Largest standard error in degrees of a normal that counts as solved here, so that the capture has unsure pixels too."""

WITHOUT_WEBGL = """const { getContext } = HTMLCanvasElement.prototype;
HTMLCanvasElement.prototype.getContext = function (kind, ...given) {
  return kind === "webgl2" ? null : getContext.call(this, kind, ...given);
};"""

PICTURES = os.environ.get("RELIT_TEST_SCREENSHOTS")
"""The folder for the pictures of the documentation; without it they are made and dropped."""


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("pages"), "--anonymous", "--device", "cpu", sabotage="long", roots=str(SAMPLES)) as running:
        yield running


@pytest.fixture(scope="session")
def client(server: Server) -> Iterator[httpx2.Client]:
    with server.client() as made:
        yield made


@pytest.fixture(scope="session")
def without_worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a service in this process, for tests that make up what its API says, or ask for nothing of it."""
    settings = Settings(data=tmp_path_factory.mktemp("without_worker"), anonymous=True)
    with app_of(settings) as app, socket.create_server(("127.0.0.1", 0)) as listening:
        running = http_server(app, settings, ConnectionLimits(100, 100))
        thread = threading.Thread(target=running.run, kwargs={"sockets": [listening]})
        thread.start()
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
        running.should_exit = True
        thread.join()


@pytest.fixture(scope="session")
def locked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that wants keys."""
    with serving(tmp_path_factory.mktemp("locked"), "--device", "none", roots=str(SAMPLES)) as running:
        yield running


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium. It ends with its module: Playwright keeps an event loop in this thread, beside which no other can run."""
    try:
        path = installed.browser()
    except installed.MissingClientError as error:
        (pytest.fail if REQUIRED else pytest.skip)(str(error))
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield running
        running.close()


def expect(found):
    """Playwright's assertions on a locator or a page, which wait for what they say; loaded when a test needs them."""
    from playwright.sync_api import expect as waiting

    waiting.set_options(timeout=PATIENCE_MS)
    return waiting(found)


def seen(page, look, what: str = "the page does not show it"):
    """Look at a page again and again until there is something, and return it; the page's requests are answered meanwhile."""
    return until(lambda: look() or page.wait_for_timeout(20), what, within_s=PATIENCE_MS / 1000)


def await_whole(page) -> None:
    """Wait until nothing of a page is invisible any more because something of it still loads."""
    page.wait_for_function("() => !document.querySelector('main').hasAttribute('aria-busy')")


def spread_fingers(canvas) -> None:
    """Move two fingers on a canvas apart, until they are twice as far from each other as at first."""
    canvas.evaluate("""(canvas) => {
      const { left, top, width, height } = canvas.getBoundingClientRect();
      canvas.setPointerCapture = () => {};
      const send = (type, id, x) => canvas.dispatchEvent(new PointerEvent(type, {
        pointerId: id, pointerType: "touch", buttons: 1, bubbles: true, clientX: left + width / 2 + x, clientY: top + height / 2 }));
      send("pointerdown", 11, -20); send("pointerdown", 12, 20);
      send("pointermove", 11, -40); send("pointermove", 12, 40);
    }""")


def new_context(browser, **options):
    """A context of the browser whose pages wait long enough on a loaded machine."""
    made = browser.new_context(**options)
    made.set_default_timeout(PATIENCE_MS)
    return made


@contextmanager
def opened_page(browser, **options):
    """A page in a context of its own; an error of a script or a breach of the content security policy fails the test."""
    context = new_context(browser, **options)
    page, errors = context.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if "Content Security Policy" in message.text else None)
    yield page
    context.close()
    assert errors == []


@pytest.fixture
def page(browser, server: Server):
    """A page of the server with the samples."""
    with page_of(browser, server.url) as opened:
        yield opened


@contextmanager
def page_of(browser, url: str):
    """A page of 1280 × 900 px, which may ask no other server."""
    own, others = (f"{url}/", "blob:", "data:"), []
    with opened_page(browser, base_url=url, viewport={"width": 1280, "height": 900}) as opened:
        opened.on("request", lambda request: None if request.url.startswith(own) else others.append(request.url))
        yield opened
    assert others == []


def alter(page, place: str, change) -> None:
    """Let `change` alter what the API says at a place."""
    def answer(route):
        found = route.fetch()
        route.fulfill(response=found, json=change(found.json()))

    page.route(place, answer)


@pytest.fixture
def open_to_axe(browser, server: Server):
    """A page whose policy lets axe be injected."""
    with opened_page(browser, base_url=server.url, bypass_csp=True) as opened:
        yield opened


@pytest.fixture
def small_page(page):
    """A page of 640 × 480 px, for views in 3D: the processor renders every pixel of them again and again."""
    page.set_viewport_size({"width": 640, "height": 480})
    return page


def count_bytes(page, *left_out: str) -> list[int]:
    """A list that gets the size of each answer that is the page's own: no data of the API, and nothing at places that are left out."""
    sizes: list[int] = []
    left = ("/v1/", *left_out)
    page.on("response", lambda answer: sizes.append(len(answer.body())) if not any(each in answer.url for each in left) else None)
    return sizes


def keep(page, name: str, folder: Path) -> None:
    """Keep what a page shows as a picture of the documentation, or in a folder of the test; of few colours, so that it is small."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    assert np.asarray(picture).std() > 1  # it is not empty
    path = (Path(PICTURES) if PICTURES else folder) / f"page_{name}.png"
    for colours in (256, 128):
        picture.quantize(colours, method=Image.Quantize.MEDIANCUT).save(path, optimize=True)
        if path.stat().st_size < 180_000:
            return
    raise AssertionError(f"{path} is large: {path.stat().st_size} bytes")


class Solved:
    """A capture that is registered, perhaps solved, and prepared, and its pages."""

    def __init__(self, server: Server, capture: str, solve: str | None) -> None:
        self.server, self.capture, self.solve = server, capture, solve
        self.pages = {"capture": f"/captures/{capture}", "light": f"/light/{capture}", "object": f"/object/{capture}"}
        if solve is not None:
            self.pages |= {"job": f"/jobs/{solve}", "maps": f"/maps/{solve}"}

    def open(self, page, name: str) -> None:
        """Open a page, and wait until it is whole."""
        page.goto(self.pages[name])
        self.wait_for_content(page, name)

    def wait_for_content(self, page, name: str) -> None:
        """Wait until a page shows what it is for, and all else of it."""
        content = {"home": ".card canvas", "machines": "#audit tbody tr", "captures": "#captures a", "jobs": "#jobs tbody tr",
                   "capture": "#frames canvas", "job": "#stages tbody tr",
                   "light": "canvas.picture[data-ready]", "object": "canvas.picture[data-ready]", "maps": "canvas.map"}[name]
        page.locator(content).first.wait_for(timeout=CONTENT_MS)
        await_whole(page)

    def result(self, job: str, name: str, folder: Path) -> Path:
        """Download a result."""
        with self.server.client() as client:
            path = folder / name
            path.write_bytes(client.get(f"/v1/jobs/{job}/results/{name}").raise_for_status().content)
        return path


def done(server: Server, client, request: dict) -> str:
    """Submit a job, and return its identifier when it has succeeded."""
    return finish(server, client, submit(client, **request))["id"]


def prepared(server: Server, client, name: str, options: dict | None) -> Solved:
    """A sample, registered, solved unless `options` is None, and prepared for the pages."""
    capture = admitted(server, client, SAMPLES / name)["id"]
    done(server, client, {"kind": "view", "capture": capture})
    return Solved(server, capture, None if options is None else solved_maps(server, client, capture, options))


def solved_maps(server: Server, client, capture: str, options: dict) -> str:
    """The job that solved a capture, its maps prepared for the pages."""
    solve = done(server, client, {"kind": "solve", "capture": capture, "options": options})
    done(server, client, {"kind": "view", "capture": capture, "maps": solve})
    return solve


@pytest.fixture(scope="session")
def solved(server: Server, client) -> Solved:
    return prepared(server, client, "lambert", {"method": "lambert", "max_sigma": MAX_SIGMA})


@pytest.fixture(scope="session")
def owl(server: Server, client) -> Solved:
    """The sample that `make serve` opens on; its material is solved for pictures of the documentation alone."""
    return prepared(server, client, "owl", {} if PICTURES else None)


@pytest.fixture(scope="session")
def material(server: Server, client, solved: Solved, owl: Solved) -> Solved:
    """A capture whose material is solved: the sample where that is, else the small one."""
    return owl if owl.solve is not None else Solved(server, solved.capture, solved_maps(server, client, solved.capture, {}))


@pytest.fixture(scope="session")
def sky(server: Server, client) -> str:
    """An environment, registered and ready."""
    return admitted(server, client, SAMPLES / "owl" / "environment.exr", kind="environments")["id"]
