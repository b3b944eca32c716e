"""The preview of a capture that has just been taken: its normals, and a relit picture, before it is solved in full."""

import json
import tempfile
from pathlib import Path

import numpy as np

from kernels.status import ESTIMATED
from service.relight.relight import relight
from service.relight.sheet import AS_EVER, BACKGROUND, display, exposure_of, fit, read_frame, write_sheet
from service.reporting.progress import Progress, Timings
from service.requests.relight import RelightRequest
from service.requests.solve import Intensities, Method, SolveRequest
from service.solve.opening import open_solve
from stage.colour.colour_spaces import Review

PREVIEW_FILE = "preview.png"
ROWS = 480
"""Pixels of the height of each picture, at most."""
KEY_LIGHT = {"name": "key", "keys": [{"frame": 1, "direction": [-0.5, 0.6, 0.62], "irradiance": [3, 3, 3], "angle_degrees": 20}]}
"""The light of the relit picture, a large lamp above left of the camera."""


def write_preview(capture: Path, device: str | None, progress: Progress | None = None, *, review: Review = AS_EVER) -> Path:
    """Write preview.png into the folder of a capture, and return its path.

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
    return path
