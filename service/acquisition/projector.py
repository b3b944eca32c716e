"""A projector: a page in a browser on its screen, which shows patterns pixel by pixel and tells when each has been painted."""

import threading
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import numpy as np
import uvicorn
from fastapi import FastAPI, Query, Response
from fastapi.responses import FileResponse

from service.errors import RequestError
from service.twin.local_page import HEADERS, page_address, page_socket
from stage.files import replacing
from stage.formats.images import write_png

STATIC = Path(str(files("service"))) / "acquisition" / "static"
POLL_S = 10.0
"""How long the page waits for an answer before it asks again."""


class Projector:
    """Shows patterns through a page that is served on the loopback."""

    def __init__(self, resolution: tuple[int, int], port: int, timeout_s: float, spool: Path) -> None:
        """Serve the page; patterns are shown once it is open.
        `resolution`: width and height of the projector in pixels. `port`: of the page; 0: any free one. Raises RequestError if the port is
        in use."""
        self._resolution, self._timeout, self._image = resolution, timeout_s, spool / "pattern.png"
        self._changed = threading.Condition()
        self._number, self._shown, self._closing = 0, 0, False
        self._window: tuple[int, int] | None = None
        listening = page_socket(port, "--projector-port")
        self.address = page_address(listening)
        """The address of the page."""
        self._server = uvicorn.Server(uvicorn.Config(self._app(), ws="none", log_config=None, log_level="warning", access_log=False,
                                                     timeout_graceful_shutdown=1))
        self._thread = threading.Thread(target=self._server.run, args=[[listening]], name="relit-projector", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait until a window of the projector's size is open. Raises RequestError if there is none in time."""
        with self._changed:
            if self._changed.wait_for(lambda: self._window == self._resolution, self._timeout):
                return
        advice = "click into it on the projector's screen, so that it fills it, or give its size to --projector"
        if self._window is None:
            raise RequestError(f"--projector: no window has opened {self.address} within {self._timeout:g} s: open it in a browser on the "
                               "projector's screen")
        (width, height), (columns, rows) = self._window, self._resolution
        raise RequestError(f"--projector: the window of {self.address} has {width}x{height} pixels, the projector {columns}x{rows}: "
                           f"{advice}")

    def show(self, levels: np.ndarray) -> None:
        """Show an image, [rows, cols] uint8 as the projector gets it, and return when the page has painted it.
        Raises RequestError if it has not painted it in time."""
        with replacing(self._image, flush=False) as temporary:
            write_png(temporary, levels, srgb=False)
        with self._changed:
            self._number += 1
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: self._shown == self._number, self._timeout):
                raise RequestError(f"--projector: the window of {self.address} has not painted a pattern within {self._timeout:g} s: is it "
                                   "still open, and in front?")

    def close(self) -> None:
        """End the page."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._server.should_exit = True
        self._thread.join()

    def _app(self) -> FastAPI:
        app = FastAPI(title="Relit projector", docs_url=None, redoc_url=None, openapi_url=None)

        @app.get("/")
        def home() -> Response:
            return FileResponse(STATIC / "projector.html", headers=HEADERS)

        @app.get("/projector.js")
        def script() -> Response:
            return FileResponse(STATIC / "projector.js", headers=HEADERS)

        @app.get("/next")
        def following(after: int, width: Annotated[int, Query(ge=0)], height: Annotated[int, Query(ge=0)]) -> dict[str, int | None]:
            with self._changed:
                self._window = width, height
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._number != after or self._closing, POLL_S)
                return {"number": self._number if self._number not in (0, after) else None}

        @app.get("/pattern.png")
        def pattern() -> Response:
            return Response(self._image.read_bytes(), media_type="image/png", headers=HEADERS)

        @app.post("/shown")
        def shown(number: int) -> Response:
            with self._changed:
                self._shown = number
                self._changed.notify_all()
            return Response(status_code=204)

        return app
