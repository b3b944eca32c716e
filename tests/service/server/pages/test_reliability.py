"""Pages come alive whatever happens to them: Back, Forward, reload, a second tab, a lost network, a killed server."""

import os
import random
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from tests.scenes.captures import make_scene, write_capture
from tests.service.server.api.job_calls import admitted
from tests.service.server.pages.conftest import Solved, done, new_context
from tests.service.server_process import Server, serving

pytestmark = pytest.mark.long

STEPS = 100
STARTS = (31, 67)
"""Steps at which the server is killed and started again: starting takes seconds, so that chance does not choose them."""
MOST_TABS = 3
"""Tabs that stay open: a browser gives a server six connections, and each tab that watches jobs holds one."""
ACTIONS = ("go", "go", "back", "back", "forward", "reload", "tab", "offline", "hasty")
CONTENT = {"light": "canvas.picture[data-ready]", "object": "canvas.picture[data-ready]", "maps": "canvas.map",
           "capture": "#frames canvas", "job": "#stages tbody tr",
           "jobs": "#jobs tbody a", "captures": "#captures tbody a", "home": ".card",
           "machines": "#audit tbody tr", "asset": "canvas.scene[data-share='1']", "photographs": "[data-shows=photographs] figure canvas"}


class Restartable:
    """A server of its own, which can be killed and started again at the same address."""

    def __init__(self, folder) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._options = (folder, "--anonymous", "--device", "cpu", "--port", str(free.getsockname()[1]))
        self.capture = write_capture(folder / "small", make_scene(size=32, lights=8))
        self._stack = ExitStack()
        self.server: Server = self._start()

    def _start(self) -> Server:
        return self._stack.enter_context(serving(*self._options, roots=str(self.capture)))

    def kill(self) -> None:
        os.killpg(self.server.process.pid, signal.SIGKILL)
        self.server.process.wait()

    def start(self) -> None:
        self.server = self._start()

    def close(self) -> None:
        self._stack.close()


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> Iterator[tuple[Restartable, dict[str, str]]]:
    """A server, and the addresses of its pages. Its capture is small, since what is tried is not how fast pictures are drawn."""
    made = Restartable(tmp_path_factory.mktemp("restartable"))
    with made.server.client() as client:
        capture = admitted(made.server, client, made.capture)["id"]
        solve = done(made.server, client, {"kind": "solve", "capture": capture, "options": {"method": "lambert"}})
        for view in ({}, {"maps": solve}):
            done(made.server, client, {"kind": "view", "capture": capture, **view})
        asset = done(made.server, client, {"kind": "export", "maps": solve})
    yield made, Solved(made.server, capture, solve).pages | {
        "jobs": "/jobs", "captures": "/captures", "home": "/", "machines": "/machines", "asset": f"/asset/{asset}",
        "photographs": f"/object/{capture}#mode=photographs"}
    made.close()


def wait_alive(page, name: str) -> None:
    """Wait until a page shows what it is for; where a module of it was lost, the page says so and has a link, which is used."""
    from playwright.sync_api import TimeoutError as TookTooLong

    late = page.locator("#stuck a:visible")
    page.locator(CONTENT[name]).or_(late).first.wait_for()
    if late.count() > 0:
        with suppress(TookTooLong):  # the link goes where the page comes after all
            late.click(timeout=10_000)
        page.locator(CONTENT[name]).first.wait_for()


@pytest.mark.parametrize("seed", [4])
def test_no_page_is_ever_dead(browser, own, seed):
    restartable, pages = own
    chance = random.Random(seed)
    context = new_context(browser, base_url=restartable.server.url)
    page, visited, at = context.new_page(), [], -1

    def go(name: str, wait: str = "load") -> None:
        nonlocal at
        page.goto(pages[name], wait_until=wait)
        visited[at + 1:] = [name]
        at += 1

    def other() -> str:
        """Return another page than the one that is shown: a browser puts none into its history that is asked for again."""
        return chance.choice([name for name in pages if not visited or name != visited[at]])

    def leave() -> None:
        """Go to another page, up to where its document is there: modules and data are lost, as nothing could say that a document is."""
        go(other(), wait="commit")
        page.locator("main").wait_for(state="attached")

    go("light")
    for step in range(STEPS):
        wait_alive(page, visited[at])
        action = "restart" if step in STARTS else chance.choice(ACTIONS)
        print(step, action, visited[at])
        if action == "back" and at > 0:
            at -= 1
            page.go_back()
        elif action == "forward" and at < len(visited) - 1:
            at += 1
            page.go_forward()
        elif action == "reload":
            page.reload()
        elif action == "tab":
            page, visited, at = context.new_page(), [], -1
            for old in context.pages[:-MOST_TABS]:
                old.close()
            go(other())
        elif action == "hasty":  # the next page is asked for before this one has loaded
            go(other(), wait="commit")
            go(other())
        elif action == "offline":
            leave()
            context.set_offline(True)
            page.locator("#connection:visible, #stuck:visible").or_(page.locator(CONTENT[visited[at]])).first.wait_for()
            context.set_offline(False)
        elif action == "restart":
            leave()
            restartable.kill()
            page.locator("#connection:visible, #stuck:visible").or_(page.locator(CONTENT[visited[at]])).first.wait_for()
            restartable.start()
        else:
            go(other())
    wait_alive(page, visited[at])
    context.close()


def test_what_stays_away_is_said_with_a_button_and_comes_back(browser, own):
    restartable, pages = own
    context = new_context(browser, base_url=restartable.server.url)
    page = context.new_page()
    page.clock.install()
    page.route("**/v1/**", lambda route: route.abort())
    page.route("**/healthz", lambda route: route.abort())
    page.goto(pages["light"])
    page.locator("main[aria-busy=true]").wait_for()
    page.clock.fast_forward(500)
    alert = page.get_by_role("alert").filter(has_text="The server cannot be reached.")
    while alert.count() == 0:  # each wait is passed over when it has begun
        page.clock.run_for(20_000)
    page.get_by_role("button", name="Try again").click()
    page.get_by_role("status").filter(has_text="The connection is lost").wait_for()
    page.unroute_all()
    page.clock.resume()
    wait_alive(page, "light")
    context.close()

