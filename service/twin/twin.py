"""The twin of a stage: listen, show (the picture and the dome of lamps on a page), and write down what was received."""

import socket
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import uvicorn
from fastapi import FastAPI, Query, Response
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles

from service.errors import RequestError
from service.play.play import Prepared, prepare, run
from service.play.show import driven_universes, with_protocol
from service.reporting.progress import Progress, Timings
from service.requests.play import PictureFormat, PlayRequest, TwinRequest
from service.twin.camera import NOT_ON_A_CARD, TwinCamera, TwinPicture, card_kept, fault_spans
from service.twin.fixtures import UniverseId
from service.twin.listener import ANY, Listener
from service.twin.local_page import HEADERS, page_address, page_socket
from stage.errors import storage
from stage.files import write_text
from stage.formats.csv_table import table_text
from stage.rig.patch import levels_of_universes
from stage.rig.rig import Rig, read_rig

PICTURES = (".exr", ".png")
LOOPBACK = "127.0.0.1"
SERVICE = Path(str(files("service")))
STATIC, PAGE = SERVICE / "server" / "pages" / "static", SERVICE / "twin" / "static"
"""The style and the modules of the service's pages, and the page of the twin."""
PICTURE_ROWS = 480
"""The most rows of the picture on the page, of which a browser draws several a second."""


class TwinResult(NamedTuple):
    """A summary of what was received."""

    frames: int
    """Number of whole frames."""
    out_of_order: int
    """Number of packets that were left out because a later one had arrived."""


class Twin(NamedTuple):
    """A twin that is ready to listen."""

    rig: Rig
    universes: Collection[UniverseId]
    picture: TwinPicture
    player: Prepared | None
    """The cues that are sent to it from here."""


def open_twin(request: TwinRequest, progress: Progress | None = None) -> Twin:
    """Read the rig and the images of the capture.
    Raises RequestError if a suffix is unknown. Raises StageError or KernelError: bad input; names file and field."""
    if request.snapshot is not None and request.snapshot.suffix.lower() not in PICTURES:
        raise RequestError(f"--snapshot {request.snapshot}: end the name in {' or '.join(PICTURES)}")
    if request.pictures is not None and (request.snapshot or request.frames or request.after):
        raise RequestError("--pictures needs the page: leave out --snapshot, --frames and --after")
    if request.picture_format is PictureFormat.CARD and (kind := next((span.kind for span in fault_spans(request.faults)
                                                                      if span.kind in NOT_ON_A_CARD), None)) is not None:
        raise RequestError(f"--faults {kind}: the picture of --picture-format card is always there: leave it out")
    rig = with_protocol(read_rig(request.rig), request.protocol)
    universes = driven_universes(request.rig, rig).keys()
    player = None
    if request.play is not None:
        host = LOOPBACK if request.interface == ANY else request.interface
        player = prepare(PlayRequest(cues=request.play, rig=request.rig, protocol=request.protocol, loop=True, host=host))
    return Twin(rig, universes, TwinPicture(rig, request, Timings(progress)), player)


def rehearse(twin: Twin, request: TwinRequest, listening: Callable[[str | None], None]) -> TwinResult:
    """Receive what is sent to a rig until the request's end or an interruption, and show or write it.
    `listening`: called when the twin listens, with the address of its page, if there is one. Raises RequestError if a port is in use, or no
    frame came. Raises StorageError if a file cannot be written."""
    rig, universes, picture, player = twin
    if request.pictures is not None:
        with storage("write", request.pictures):
            request.pictures.mkdir(parents=True, exist_ok=True)
    ends = request.frames is not None or request.after is not None or request.snapshot is not None
    most = 1 if ends and request.after is None and request.frames is None else request.frames
    with Listener(universes, request.interface, keep=request.record is not None, most=most) as listener:
        page = None if ends else page_socket(request.port, "--port")
        listening(None if page is None else page_address(page))
        try:
            with _playing(player):
                if page is not None:
                    camera = None if request.pictures is None else TwinCamera(rig, picture, listener, request.pictures, request)
                    with card_kept(camera):
                        serve_page(page, rig, listener, picture, camera)
                else:
                    listener.wait(most, None if request.after is None else time.monotonic() + request.after)
        except KeyboardInterrupt:
            pass  # which ends a rehearsal as it should
    if request.snapshot is not None:
        if listener.last.number == 0:
            raise RequestError(f"--snapshot {request.snapshot}: no frame was received on {request.interface}")
        picture.write(request.snapshot, levels_of_universes(rig, dict(listener.last.values)))
    if request.record is not None:
        _record(request.record, rig, listener)
    return TwinResult(listener.last.number, listener.fixtures.out_of_order)


@contextmanager
def _playing(player: Prepared | None) -> Iterator[None]:
    """Send a show from a thread until the block ends, if there is one."""
    if player is None:
        yield
        return
    stop = threading.Event()
    with ThreadPoolExecutor(1, thread_name_prefix="relit-play") as pool:
        playing = pool.submit(run, player, stop)
        try:
            yield
        finally:
            stop.set()
    playing.result()


def _record(path: Path, rig: Rig, listener: Listener) -> None:
    columns = ["frame", "time_s", *(f"{rig.lights[index].name}.{primary.name}" for index, primary in rig.emitters)]
    write_text(path, table_text(columns, (
        [frame.number, f"{frame.time_s:.6f}", *(f"{level:.9g}" for level in levels_of_universes(rig, dict(frame.values)))]
        for frame in listener.kept)))


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
