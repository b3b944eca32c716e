"""The images of a capture, decoded into the stack of a solve while others are taken, and the preview of a capture that has just been taken:
its normals, and a relit picture, before it is solved in full.
"""

import json
import queue
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels.status import ESTIMATED
from service.acquisition.plans.shots import Shot
from service.light_estimation.declared_lights import declared_light_sentences
from service.light_estimation.lit_object import lit_object
from service.relight.relight import relight
from service.relight.sheet import AS_EVER, BACKGROUND, display, exposure_of, fit, read_frame, write_sheet
from service.reporting.progress import Progress, Timings
from service.requests.relight import RelightRequest
from service.requests.solve import Intensities, Method, SolveRequest
from service.solve.opening import open_solve
from stage.capture.capture import Capture, source_places
from stage.capture.manifest import FILE_NAME, read_manifest
from stage.capture.point_lights import DistantLights
from stage.colour.colour_spaces import Review
from stage.errors import StageError
from stage.stack.early import EarlyStack
from stage.stack.ingest import CACHE_FOLDER, Ingest

PREVIEW_FILE = "preview.png"
ROWS = 480
"""Pixels of the height of each picture, at most."""
KEY_LIGHT = {"name": "key", "keys": [{"frame": 1, "direction": [-0.5, 0.6, 0.62], "irradiance": [3, 3, 3], "angle_degrees": 20}]}
"""The light of the relit picture, a large lamp above left of the camera."""


class EarlyIngest:
    """Takes note of pictures as they come, and decodes them in a thread of its own, once one has been taken in this run."""

    def __init__(self, folder: Path, shots: Sequence[Shot]) -> None:
        """Find which shots of the capture itself are light frames; nothing is decoded yet."""
        own = [shot for shot in shots if not shot.folder]
        self._folder = folder
        self._lights = {own[index].name: light for light, index in enumerate(source_places([shot.light for shot in own]))}
        self._early = EarlyStack(folder / CACHE_FOLDER, len(self._lights))
        self._waiting: queue.Queue[str | None] = queue.Queue()
        self._stopped = False
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Do nothing: the first new picture begins."""

    def send(self, name: str, *, new: bool) -> None:
        """Decode a picture of the capture when those before it are decoded; returns at once."""
        self._waiting.put(name)
        if new and self._thread is None:
            self._thread = threading.Thread(target=self._run, name="relit-early-ingest", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End, as the capture has ended before its last picture; done once more, it does nothing."""
        self._stopped = True
        self._end()
        self._early.close()

    def finish(self) -> None:
        """Complete the stack, which the preview and a solve then find.
        Raises StageError if an image cannot be read, or the stack not be written."""
        self._end()
        try:
            if self._lights:
                self._early.remember()
                Ingest.of(Capture.open(self._folder)).stack(early=self._early)
        finally:
            self._early.close()

    def _end(self) -> None:
        self._waiting.put(None)
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while (name := self._waiting.get()) is not None:
            light = self._lights.get(Path(name).stem)
            if light is None or self._stopped:
                continue
            try:
                capture = Capture(self._folder, read_manifest(self._folder / FILE_NAME))  # all files are checked in the end
                for frame in capture.manifest.frames:
                    if frame.image == name:
                        self._early.add(capture, frame, light)
            except (StageError, MemoryError):  # no more is decoded before all are there; `finish` says what is wrong if it still is
                self._stopped = True


class Preview(NamedTuple):
    """The preview of a capture that has just been taken."""

    path: Path
    warnings: tuple[str, ...]
    """What all pictures together say against the lights of the rig, or the exposures: none of them shows it alone."""


def write_preview(capture: Path, device: str | None, progress: Progress | None = None, *, review: Review = AS_EVER) -> Preview:
    """Write preview.png into the folder of a capture.

    Normals are those of least squares on the lights in neither shadow nor highlight, without the judgement of a solve, its height and its
    material; the images are put into the stack that a solve reads after it. Raises RequestError, StageError or KernelError if the capture
    has too few lights, or other frames than a solve needs."""
    request = SolveRequest(capture=capture, out=capture, method=Method.ROBUST, intensities=Intensities.DECLARED, device=device)
    opened = open_solve(request, None, Timings(progress), None)
    solution = opened.solver(opened.given, opened.lights)
    shape = opened.given.mask.shape
    rows = min(shape[0], ROWS)
    known = np.isin(solution.status, ESTIMATED).reshape(*shape, 1)
    normals = np.where(known, 0.5 + 0.5 * np.moveaxis(solution.normal.reshape(3, *shape), 0, -1), BACKGROUND)
    with tempfile.TemporaryDirectory(prefix="relit-preview-") as folder:
        keys = Path(folder) / "keys.json"
        keys.write_text(json.dumps({"schema": "relit.keys/1", "lights": [KEY_LIGHT]}))
        made = relight(RelightRequest(capture=capture, keys=keys, out=f"{folder}/frame.####.exr", device=device), progress)
        relit, space = read_frame(made.frames[0])
    relit = fit(relit, rows, kernel="triangle")  # a view transforms a megapixel in a second
    seen = fit(np.repeat(known, 3, axis=2), rows, kernel="triangle")[..., 0] > 0
    path = capture / PREVIEW_FILE
    shown = display(relit * exposure_of(relit[None], seen), space, review)
    write_sheet(path, [[("normals", fit(normals, rows, kernel="triangle")), ("relit from above left", shown)]], height=rows)
    said = declared_light_sentences(opened.given.stack, opened.capture, opened.lights, opened.given.mask & lit_object(
        solution.albedo.astype(np.float32).mean(axis=0).reshape(shape))) if isinstance(opened.lights, DistantLights) else []
    return Preview(path, (*opened.capture.doubts, *said))
