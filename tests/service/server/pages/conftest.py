"""A server with the samples, and pages of it in headless Chromium.

Chromium is Debian's. Without it these tests are skipped, unless RELIT_TEST_PAGES is `required`, as .ci/run sets it.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.server_process import Server, serving

SAMPLES = Path(__file__).resolve().parents[4] / "samples"
REQUIRED = os.environ.get("RELIT_TEST_PAGES") == "required"
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking", "--disable-sync",
             "--disable-component-update", "--no-first-run", "--disable-quic"]
"""WebGL is rendered by the processor; without the others, Chromium asks servers of its maker."""


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("pages"), "--anonymous", "--device", "cpu", roots=str(SAMPLES), requests_per_second="10000",
                 request_burst="10000", min_free_bytes="0") as running:
        yield running


@pytest.fixture(scope="session")
def browser():
    path = shutil.which("chromium")
    if path is None:
        (pytest.fail if REQUIRED else pytest.skip)("chromium is not installed: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield running
        running.close()


@pytest.fixture
def page(browser, server: Server):
    """A page of 1280 × 900 px; an error of a script, or a breach of the content security policy, fails the test."""
    context = browser.new_context(base_url=server.url, viewport={"width": 1280, "height": 900})
    opened, errors = context.new_page(), []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("console", lambda message: errors.append(message.text) if "Content Security Policy" in message.text else None)
    yield opened
    context.close()
    assert errors == []
