"""The page of the twin: the picture and the dome of lamps, as they change."""

import socket
import tempfile
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import uvicorn
from fastapi import FastAPI, Query, Response
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles

from service.twin.camera import TwinCamera
from service.twin.listener import Listener
from service.twin.local_page import HEADERS
from service.twin.picture import TwinPicture
from stage.rig.patch import levels_of_universes
from stage.rig.rig import Rig

SERVICE = Path(str(files("service")))
STATIC, PAGE = SERVICE / "server" / "pages" / "static", SERVICE / "twin" / "static"
"""The style and the modules of the service's pages, and the page of the twin."""
PICTURE_ROWS = 480
"""The most rows of the picture on the page, of which a browser draws several a second."""


def serve_page(listening: socket.socket, rig: Rig, listener: Listener, picture: TwinPicture, camera: TwinCamera | None) -> None:
    """Serve the page on a socket until the program is interrupted."""
    app = make_app(rig, listener, picture, camera)
    config = uvicorn.Config(app, ws="none", log_config=None, log_level="warning", access_log=False, timeout_graceful_shutdown=1)
    uvicorn.Server(config).run(sockets=[listening])


def make_app(rig: Rig, listener: Listener, picture: TwinPicture, camera: TwinCamera | None = None) -> FastAPI:
    """Return the app of the page; with a camera that has no card, a POST to /release takes a picture."""
    app = FastAPI(title="Relit twin", docs_url=None, redoc_url=None, openapi_url=None)
    app.mount("/static", StaticFiles(directory=STATIC))
    lamps = np.array([index for index, _ in rig.emitters])
    light = np.array([primary.irradiance for _, primary in rig.emitters])
    full = np.zeros((len(rig.lights), 3))
    np.add.at(full, lamps, light)

    @app.get("/")
    def home() -> Response:
        return FileResponse(PAGE / "twin.html", headers=HEADERS)

    @app.get("/twin.js")
    def script() -> Response:
        return FileResponse(PAGE / "twin.js", headers=HEADERS)

    @app.get("/rig.json")
    def described() -> dict[str, Any]:
        return {"name": rig.name, "lamps": [{"name": lamp.name, "direction": direction} for lamp, direction in
                                            zip(rig.lights, rig.directions.tolist(), strict=True)]}

    @app.get("/state.json")
    def state() -> dict[str, Any]:
        frame = listener.last
        levels = levels_of_universes(rig, dict(frame.values))
        given = np.zeros_like(full)
        np.add.at(given, lamps, levels[:, None] * light)
        return {"frame": frame.number, "out_of_order": listener.fixtures.out_of_order, "colours": (given / full.max()).round(4).tolist(),
                "levels": [levels[lamps == index].round(4).tolist() for index in range(len(rig.lights))]}

    @app.get("/picture.png")
    def seen() -> Response:
        levels = levels_of_universes(rig, dict(listener.last.values))
        with tempfile.TemporaryDirectory(prefix="relit-twin-") as folder:
            path = Path(folder) / "picture.png"
            picture.write(path, levels, most_rows=PICTURE_ROWS)
            return Response(path.read_bytes(), media_type="image/png", headers=HEADERS)

    if camera is not None and not camera.card:
        @app.post("/release")
        def release(exposure_s: Annotated[float | None, Query(gt=0, allow_inf_nan=False)] = None) -> dict[str, int]:
            camera.release(exposure_s)
            return {"released": camera.released}

    return app
