"""Images to project and their manifest entries, and the planner's table."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.depth.patterns.codes import CODES, CODES_OF_OPTION
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.patterns import PatternAxis, PatternCode, PatternsRequest, PlanRequest
from stage.capture.manifest import Frame
from stage.errors import storage
from stage.files import replacing, write_text
from stage.formats.images import write_png
from stage.patterns import planner
from stage.patterns.base import Axis, UniformPattern, uniform_patterns
from stage.patterns.codes import Pattern, draw

FRAGMENT = "patterns.json"
AXES: dict[PatternAxis, tuple[Axis, ...]] = {
    PatternAxis.COLUMN: ("column",), PatternAxis.ROW: ("row",), PatternAxis.BOTH: ("column", "row"),
}


class PatternsResult(NamedTuple):
    """The files that were written."""

    images: tuple[Path, ...]
    fragment: Path
    """patterns.json, which holds the frames as capture.json takes them."""


def make_patterns(request: PatternsRequest, progress: Progress | None = None) -> PatternsResult:
    """Write PNG images and patterns.json, in place of those of an earlier run.
    Raises RequestError: an option that does not belong to the code, or that the code refuses. Raises StorageError: a file cannot be
    written."""
    for option, codes in CODES_OF_OPTION.items():
        if option in request.model_fields_set and request.code not in codes:
            raise RequestError(f"{option} says nothing about {request.code}: it is an option of {', '.join(codes)}")
    timings = Timings(progress)
    try:
        patterns = patterns_of(request)
    except ValueError as error:
        raise RequestError(str(error)) from error
    images, frames = [], []
    timings.stage("draw", len(patterns))
    for index, pattern in enumerate(patterns):
        path = request.out / f"pattern_{index:03d}.png"
        with replacing(path) as temporary:
            write_png(temporary, stored(draw(pattern, request.projector), request.bits, request.gamma), srgb=False)
        images.append(path)
        frames.append(Frame(image=path.name, pattern=pattern).model_dump(mode="json", exclude_defaults=True))
        timings.advance(index + 1)
    timings.close()
    fragment = request.out / FRAGMENT
    if fragment.exists():  # of an earlier run, which may have had more images: whoever shows all of the folder would show them too
        for path in set(request.out.glob("pattern_[0-9][0-9][0-9]*.png")) - set(images):
            with storage("remove", path):
                path.unlink()
    write_text(fragment, '{\n  "frames": [\n' + ",\n".join(f"    {json.dumps(frame)}" for frame in frames) + "\n  ]\n}\n")
    return PatternsResult(tuple(images), fragment)


def stored(levels: np.ndarray, bits: int, gamma: float) -> np.ndarray:
    """Return levels of linear light, 0…1, as whole numbers for a projector of this gamma."""
    top = 2**bits - 1
    return np.floor(np.clip(levels, 0, 1).astype(np.float64) ** (1 / gamma) * top + 0.5).astype(np.uint8 if bits == 8 else np.uint16)


def patterns_of(request: PatternsRequest) -> tuple[Pattern, ...]:
    """Return the manifest entries of one request; white and black once, at the end. Raise ValueError if the code refuses an option."""
    every = [pattern for axis in AXES[request.axis]
             for pattern in CODES[request.code].patterns(request, axis, request.projector[0 if axis == "column" else 1])]
    return (*(pattern for pattern in every if not isinstance(pattern, UniformPattern)), *uniform_patterns())


def make_plan(request: PlanRequest) -> tuple[planner.Plan, ...]:
    """Return the planner's table: lighting point by point and line by line, then every code.
    Raises RequestError: baseline, distance and focal length are not given together, or the planner refuses a value."""
    rig = None
    if request.baseline is not None and request.distance is not None and request.focal is not None:
        rig = planner.Rig(request.baseline, request.distance, request.focal)
    elif (request.baseline, request.distance, request.focal) != (None, None, None):
        raise RequestError("the depth's precision needs baseline, distance and focal together: give all three, or none")
    across = request.axis == PatternAxis.ROW
    columns, rows = request.projector[::-1] if across else request.projector
    costs = [planner.Cost(name, count, count, planner.STRIPE_SIGMA) for name, count in (("point", columns * rows), ("line", columns))]
    try:
        costs += [cost(request, columns) for code in PatternCode if (cost := CODES[code].cost) is not None]
        return planner.tabulate(costs, frame_rate=request.frame_rate, rig=rig)
    except ValueError as error:
        raise RequestError(str(error)) from error
