"""The live view of a camera under the lamps: a process of its own, so that the camera is free when it has ended, however it ends.

It writes one picture after another, striped where it clips, with a histogram below it, and tells of each on a line of its output.
"""

import json
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any, Self

import numpy as np

from service.acquisition.cameras.camera import LIVE, Setup, open_camera
from service.acquisition.checks.judge import FULL_SCALE
from service.acquisition.checks.picture_sample import TILE_PX, place_of_tile
from service.acquisition.lights.lights import Lights
from service.acquisition.meter import BINS, bars, focus_of, zebra
from service.acquisition.plans.shots import even_levels
from service.errors import USER_ERRORS, RequestError, sentence
from service.play.play import ended_by_signals
from service.twin.local_page import HEADERS
from stage.colour.colour import linearise
from stage.files import replacing
from stage.formats.images import write_png
from stage.rig.rig import read_rig

SPACE = "srgb_texture"
"""The colour space of live pictures, which cameras make for a screen."""
PICTURE = "live.png"
PERIOD_S, TOLD_EVERY = 0.2, 3
"""The least time between two pictures, and the number of pictures between two readings, which a person could not read faster."""
HISTOGRAM_PART = 5
"""The height of a picture over that of the histogram below it."""
END_S = 10.0
"""The longest time until the lamps are dark and the camera is free."""
STATIC = Path(str(files("service"))) / "acquisition" / "static"
FILES = {"/": ("live.html", "text/html; charset=utf-8"), "/live.js": ("live.js", "text/javascript")}
POLL_S = 0.05


class LiveView:
    """A live view that runs."""

    def __init__(self, rig: Path, camera: str, folder: Path) -> None:
        """Start the process; `folder` takes its pictures. Raises RequestError if the kind of camera has no live view."""
        if camera.partition(":")[0] not in LIVE:
            raise RequestError(f"--camera {camera}: has no live view")
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / PICTURE
        self._path.unlink(missing_ok=True)
        self._told: dict[str, Any] = {}
        self._process = subprocess.Popen([sys.executable, "-m", "service.acquisition.live_view", str(rig), camera, str(folder)], text=True,
                                         stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, start_new_session=True)
        threading.Thread(target=self._listen, name="relit-live", daemon=True).start()

    def state(self) -> dict[str, Any]:
        """Return the number of the last picture, the share of it that clips and its focus score; `refused` says why there is none."""
        ended = None if self._process.poll() is None else "the live view has ended"
        return {"number": 0, "clipped": None, "focus": None, "refused": ended} | self._told

    def picture(self) -> bytes | None:
        """Return the last picture as PNG; None: there is none yet."""
        return self._path.read_bytes() if self._path.exists() else None

    def close(self) -> None:
        """End it, and wait until the lamps are dark and the camera is free."""
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:  # the camera does not answer
            self._process.kill()
            self._process.wait()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._told = json.loads(line)


def look(rig_path: Path, camera: str, folder: Path, stop: threading.Event) -> None:
    """Show what a camera sees under all lamps, until `stop` is set; the lamps are dark at the end.
    Raises RequestError if the lamps or the camera do not answer, or the camera has no live view."""
    rig = read_rig(rig_path)
    setup = Setup(folder, END_S, (), None, jpeg=True)  # the format of pictures is not the live view's
    with closing(open_camera(camera, setup)) as opened, closing(Lights(rig_path, rig, lambda what: None)) as lights:  # none is asked
        lights.set(even_levels(rig))
        number, place, told = 0, None, {}
        while not stop.is_set():
            began = time.monotonic()
            pixels = opened.look()
            place = place or place_of_tile(pixels)
            number += 1
            with replacing(folder / PICTURE, flush=False) as temporary:
                write_png(temporary, np.round(255 * np.clip(_shown(pixels), 0, 1)).astype(np.uint8), srgb=True)
            if number % TOLD_EVERY == 1:
                tile = pixels[place[0]:place[0] + TILE_PX, place[1]:place[1] + TILE_PX]
                told = {"focus": focus_of(linearise(tile, SPACE).mean(axis=2)), "clipped": float((pixels.max(axis=2) >= FULL_SCALE).mean())}
            print(json.dumps({"number": number, **told}), flush=True)
            stop.wait(PERIOD_S - (time.monotonic() - began))


def _shown(pixels: np.ndarray) -> np.ndarray:
    """Return a picture with stripes where it clips, and below it the histogram of its brightest channel, the part that clips red."""
    striped = zebra(pixels, SPACE, FULL_SCALE)
    counts = np.histogram(pixels.max(axis=2), bins=BINS, range=(0, 1))[0]
    return np.vstack([striped, bars(counts, max(1, len(striped) // HISTOGRAM_PART), striped.shape[1])])


def main(rig: str, camera: str, folder: str) -> int:
    """Run the process; a refusal is its last line."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal, which the program that started this one hears too
    try:
        with ended_by_signals(threading.Event()) as stop:
            look(Path(rig), camera, Path(folder), stop)
    except USER_ERRORS as error:
        print(json.dumps({"refused": sentence(error)}), flush=True)
        return 1
    except BrokenPipeError:  # the program that started this one is gone
        return 1
    return 0


class LivePage:
    """Serves the page on the loopback as long as it is open; afterwards the lamps are dark and the camera is free."""

    def __init__(self, rig: Path, camera: str, folder: Path) -> None:
        """Take what a live view takes; nothing begins yet."""
        self._given = rig, camera, folder

    def __enter__(self) -> Self:
        """Start the live view, and serve the page at any free port. Raises RequestError if the kind of camera has no live view."""
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


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
