"""The twin of a stage: listen, show, and write down what was received."""

import csv
import io
import threading
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from service.errors import RequestError
from service.play.addresses import driven_universes, with_protocol
from service.play.play import Prepared, prepare, run
from service.reporting.progress import Progress, Timings
from service.requests.play import PictureFormat, PlayRequest, TwinRequest
from service.twin.camera import NOT_ON_A_CARD, TwinCamera, card_kept, fault_spans
from service.twin.fixtures import UniverseId
from service.twin.listener import ANY, Listener
from service.twin.local_page import page_address, page_socket
from service.twin.page import serve_page
from service.twin.picture import TwinPicture
from stage.errors import storage
from stage.files import write_text
from stage.rig.patch import levels_of_universes
from stage.rig.rig import Rig, read_rig

PICTURES = (".exr", ".png")
LOOPBACK = "127.0.0.1"


class TwinResult(NamedTuple):
    """What was received."""

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

    Raises:
        RequestError: a suffix is unknown.
        StageError, KernelError: bad input; names file and field.
    """
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

    Args:
        listening: called when the twin listens, with the address of its page, if there is one.

    Raises:
        RequestError: a port is in use, or no frame came.
        StorageError: a file cannot be written.
    """
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
    """Write the levels of every frame as a table."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "time_s", *(f"{rig.lights[index].name}.{primary.name}" for index, primary in rig.emitters)])
    for frame in listener.kept:
        levels = levels_of_universes(rig, dict(frame.values))
        table.writerow([frame.number, f"{frame.time_s:.6f}", *(f"{level:.9g}" for level in levels)])
    write_text(path, text.getvalue())
