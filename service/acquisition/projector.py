"""A projector: a page in a browser on its screen, which shows patterns pixel by pixel and tells when each has been painted.

Levels with which its patterns are linear light follow from its gamma, or from a response that is measured before them.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import uvicorn
from fastapi import FastAPI, Query
from fastapi import Response as HttpResponse
from fastapi.responses import FileResponse

from service.acquisition.checks.judge import FULL_SCALE
from service.acquisition.checks.picture_sample import stride
from service.acquisition.plans.shots import Shot
from service.calibrate.response import EVEN_LEVELS, MOST_PIXELS, Response, fit_response
from service.depth.patterns.projection import stored
from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from service.twin.local_page import HEADERS, page_address, page_socket
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.errors import CalibrationError
from stage.files import replacing
from stage.formats import images
from stage.formats.images import write_png
from stage.importers.layout import color_space_of
from stage.patterns.base import UniformPattern
from stage.patterns.codes import draw

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
        def home() -> HttpResponse:
            return FileResponse(STATIC / "projector.html", headers=HEADERS)

        @app.get("/projector.js")
        def script() -> HttpResponse:
            return FileResponse(STATIC / "projector.js", headers=HEADERS)

        @app.get("/next")
        def following(after: int, width: Annotated[int, Query(ge=0)], height: Annotated[int, Query(ge=0)]) -> dict[str, int | None]:
            with self._changed:
                self._window = width, height
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._number != after or self._closing, POLL_S)
                return {"number": self._number if self._number not in (0, after) else None}

        @app.get("/pattern.png")
        def pattern() -> HttpResponse:
            return HttpResponse(self._image.read_bytes(), media_type="image/png", headers=HEADERS)

        @app.post("/shown")
        def shown(number: int) -> HttpResponse:
            with self._changed:
                self._shown = number
                self._changed.notify_all()
            return HttpResponse(status_code=204)

        return app


class PatternImages:
    """The images of the projector of one capture."""

    def __init__(self, request: AcquireRequest, shots: Sequence[Shot]) -> None:
        """Take note of the options. Raises RequestError if both the options and the plan say how the projector responds."""
        self._request, self._measures = request, any(shot.grey is not None for shot in shots)
        self.response: Response | None = None
        """The response of the projector, once the first pattern has been shown through it."""
        if request.gamma != 1 and self._measures:
            raise RequestError(f"--gamma: is {request.gamma:g}, and the plan measures the projector's response: leave one of them out")

    def image(self, shot: Shot, greys: Callable[[], Mapping[float, Path]]) -> np.ndarray:
        """Return what the projector is given for a shot, [rows, cols] or [rows, cols, 3] uint8; black where it shows nothing.
        `greys`: returns the pictures of even grey, by its level. Raises RequestError if those pictures do not show a response; names their
        folder."""
        assert self._request.projector is not None
        if shot.grey is not None:
            return stored(np.full(self._request.projector[::-1], shot.grey), 8, 1.0)
        if shot.pattern is not None and self._measures and self.response is None:
            self.response = self._measured(greys())
        levels = draw(shot.pattern or UniformPattern(code="black"), self._request.projector)
        if self.response is None:
            return stored(levels, 8, self._request.gamma)
        return stored(np.interp(levels, self.response.values, np.linspace(0, 1, EVEN_LEVELS)), 8, 1.0)

    def entry(self) -> dict[str, Any] | None:
        """Return the response as the report holds it; None where none was measured."""
        found = self.response
        return None if found is None else {"gamma": float(f"{found.gamma:.4g}"), "spread": float(f"{found.spread:.3g}"),
                                           "values": [float(f"{value:.7g}") for value in found.values]}

    def _measured(self, pictures: Mapping[float, Path]) -> Response:
        if not pictures:
            raise RequestError("projector-response: none of its pictures came: look at the camera, and run the same command again")
        usable, readings = [], []
        for path in pictures.values():
            recorded = images.read_pixels(path)
            step = stride(recorded.shape, MOST_PIXELS)
            sparse = recorded[::step, ::step].astype(np.float32).reshape(-1, 3)
            usable.append((sparse < (self._request.saturation or FULL_SCALE)).all(axis=-1))
            readings.append(linearise(sparse, self._request.color_space or color_space_of(path)) @ np.array(GREY_WEIGHTS, np.float32))
        try:
            return fit_response(tuple(pictures), np.array(readings), usable=np.all(usable, axis=0))
        except CalibrationError as error:
            raise RequestError(f"{next(iter(pictures.values())).parent}: {error}") from error
