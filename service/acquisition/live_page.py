"""The live view of a camera on a page of this machine, for a person who frames and focuses before the light is metered."""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Self

from service.acquisition.live_view import LiveView
from service.twin.local_page import HEADERS

STATIC = Path(str(files("service"))) / "acquisition" / "static"
FILES = {"/": ("live.html", "text/html; charset=utf-8"), "/live.js": ("live.js", "text/javascript")}
POLL_S = 0.05


class LivePage:
    """Serves the page on the loopback as long as it is open; afterwards the lamps are dark and the camera is free."""

    def __init__(self, rig: Path, camera: str, folder: Path) -> None:
        """Take what a live view takes; nothing begins yet."""
        self._given = rig, camera, folder

    def __enter__(self) -> Self:
        """Start the live view, and serve the page at any free port.

        Raises:
            RequestError: the kind of camera has no live view.
        """
        self._view = LiveView(*self._given)
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self._view))
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}"
        """The address of the page."""
        threading.Thread(target=self._server.serve_forever, name="relit-live-page", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        """End both."""
        self._server.shutdown()
        self._server.server_close()
        self._view.close()

    def wait(self) -> str | None:
        """Return None when there is a picture, or why there is none."""
        while (state := self._view.state())["number"] == 0 and state["refused"] is None:
            time.sleep(POLL_S)
        refused: str | None = state["refused"]
        return refused


def _handler(view: LiveView) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Answers with the page, what the live view tells, and its picture."""

        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if path in FILES:
                name, kind = FILES[path]
                self._answer((STATIC / name).read_bytes(), kind)
            elif path == "/state.json":
                self._answer(json.dumps(view.state()).encode(), "application/json")
            elif path == "/live.png" and (picture := view.picture()) is not None:
                self._answer(picture, "image/png")
            else:
                self.send_error(404)

        def log_message(self, *_: object) -> None:
            """Say nothing."""

        def _answer(self, content: bytes, kind: str) -> None:
            self.send_response(200)
            for name, value in {**HEADERS, "Content-Type": kind, "Content-Length": str(len(content))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

    return Handler
