"""Layers of boards: the pads of a paste layer (Gerber, RS-274X with or without X2), and round marks of Gerber or Excellon drill files, read
with gerbonara, which `pip install 'relit[boards]'` installs.

A pad is what the objects of a layer that touch leave open, drawn in the order of the file, clear over dark. It is sampled at points of its
own, so that its area is that of rectangles exactly and of discs to a thousandth.
"""

import math
import re
import warnings
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import find_objects, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stage import inputs
from stage.errors import ManifestError

SAMPLES, MOST_SAMPLES = 128, 4096
"""Samples across the smallest object of a group that touches, and the most samples along a side of the group."""
TURN_STEPS = 256
"""Straight lines that stand for a full circle: its area is right to 10⁻⁴."""
MILLI = 1e-3
END = re.compile(r"(?:^|\*%?)\s*(?:D0?2)?M0?[02]\s*\*", re.MULTILINE)
"""The command that every Gerber file ends with: M02, and M00 in files of before 2012; P-CAD writes D02M02."""


class Pad(NamedTuple):
    """An opening of the stencil."""

    component: str | None
    """The component that the file names, by an attribute of X2."""
    pin: str | None
    """The pin of the component, likewise."""
    low_m: np.ndarray  # [2] x and y of the lower left corner of its box
    step_m: np.ndarray  # [2] distance of its samples
    inside: np.ndarray  # [along y, along x] bool: the samples that it holds, from its lower left corner up

    @property
    def size_m(self) -> np.ndarray:
        """Return width and height of its box, [2] metres."""
        return np.asarray(self.step_m * self.inside.shape[::-1])

    @property
    def area_m2(self) -> float:
        """Return its area."""
        return float(self.inside.sum() * self.step_m.prod())

    @property
    def centre_m(self) -> np.ndarray:
        """Return its centroid, [2] metres."""
        y, x = np.nonzero(self.inside)
        return np.asarray(self.low_m + (np.array([x.mean(), y.mean()]) + 0.5) * self.step_m)

    def holds(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return whether it holds points, bool; x and y in metres."""
        col, row = (np.floor((values - low) / step).astype(int) for values, low, step in zip((x, y), self.low_m, self.step_m, strict=True))
        rows, cols = self.inside.shape
        there = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        return np.asarray(there & self.inside[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)])

    def placed(self, *, mirrored: bool, origin_m: tuple[float, float]) -> "Pad":
        """Return it as it lies on a board that shows its other side, x to the left, and has its origin elsewhere in the layer."""
        low = self.low_m - origin_m
        if not mirrored:
            return self._replace(low_m=low)
        return self._replace(low_m=np.array([-low[0] - self.size_m[0], low[1]]), inside=self.inside[:, ::-1])


def read_pads(path: Path) -> list[Pad]:
    """Read the openings of a paste layer. Raises ManifestError if the file is no Gerber file, or has no opening; names it."""
    objects = [(shape, thing.attrs if isinstance(thing.attrs, dict) else {}) for thing, shape in _objects(path)]  # a region has none
    if not objects:
        raise ManifestError(f"{path}: is a layer without an opening")
    low, high = (np.array([pick([pick(line, axis=0) for line, _ in shape], axis=0) for shape, _ in objects]) for pick in (np.min, np.max))
    pads: list[Pad] = []
    for members in _touching(low, high):
        pads += _pads(members, objects, low, high)
    if not pads:
        raise ManifestError(f"{path}: is a layer without an opening")
    return pads


def read_marks(path: Path) -> np.ndarray:
    """Read the round marks of a drill file, or of a Gerber layer with fiducials: [n, 3], x, y and diameter in metres; holes that are milled
    are none. Raises ManifestError if the file has none; names it."""
    marks = []
    for thing, shape in _objects(path):
        line = shape[0][0]
        size = np.ptp(line, axis=0)
        if hasattr(thing, "x") and len(line) == TURN_STEPS and abs(size[0] - size[1]) < 0.01 * size[0]:
            marks.append((*((line.min(axis=0) + line.max(axis=0)) / 2), size[0]))
    if not marks:
        raise ManifestError(f"{path}: has no round hole or mark")
    return np.array(marks)


def _objects(path: Path) -> list[tuple[Any, list[tuple[np.ndarray, bool]]]]:
    """Return the objects of a Gerber or an Excellon file that cover something: each with its closed outlines, [n, 2] metres, and whether
    these are dark."""
    text = inputs.read_bytes(path).decode("utf-8", errors="replace")
    if find_spec("gerbonara") is None:
        raise ManifestError(f"{path}: Gerber and drill files need gerbonara: pip install 'relit[boards]'")
    from gerbonara import ExcellonFile, GerberFile

    kind, reader = ("Excellon", ExcellonFile) if "M48" in text[:2000] and "%FS" not in text else ("Gerber", GerberFile)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about old notations, of which it says that they are old
            things = reader.from_string(text, filename=path).objects
            found = [(thing, shape) for thing in things if (shape := list(_outlines(thing)))]
    except Exception as error:  # whatever a parser raises at text that is no layer
        said = (str(error) or type(error).__name__).splitlines()[0][:160]
        raise ManifestError(f"{path}: is no {kind} file that can be read: {said}") from error
    if found and kind == "Gerber" and not END.search(text):
        raise ManifestError(f"{path}: is truncated: it does not end with M02")
    return found


def _outlines(thing: Any) -> Iterator[tuple[np.ndarray, bool]]:
    from gerbonara import MM

    flashed = hasattr(thing, "aperture") and hasattr(thing, "x")
    place = np.array([MM(thing.x, thing.unit), MM(thing.y, thing.unit)] if flashed else [0.0, 0.0])
    # flashed at 0 and moved, because polygons of macros do not follow the place of a flash (gerbonara 1.5)
    for shape in thing.aperture.flash(0, 0, MM, thing.polarity_dark) if flashed else thing.to_primitives(MM):
        for line in _lines(shape):
            outline = (np.array(line) + place) * MILLI
            if len(outline) > 2 and np.ptp(outline, axis=0).min() > 0:
                yield outline, bool(shape.polarity_dark)


def _lines(shape: Any) -> Iterator[list[tuple[float, float]]]:
    """Yield the outlines of a shape, whose union it is, in millimetres; those that gerbonara 1.5 makes of turned rectangles, strokes and
    arcs are wrong, so that only those of polygons and regions are its own."""
    from gerbonara.graphic_primitives import Arc, Circle, Line, Rectangle

    if isinstance(shape, Circle):
        yield _arc((shape.x + shape.r, shape.y), (shape.x + shape.r, shape.y), (shape.x, shape.y), False)
    elif isinstance(shape, Rectangle):
        cos, sin = math.cos(shape.rotation), math.sin(shape.rotation)
        corners = [(side * shape.w / 2, end * shape.h / 2) for side, end in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        yield [(shape.x + cos * x - sin * y, shape.y + sin * x + cos * y) for x, y in corners]
    elif isinstance(shape, Line):
        yield _stroke((shape.x1, shape.y1), (shape.x2, shape.y2), shape.width / 2)
    elif isinstance(shape, Arc):
        ends = (shape.x1, shape.y1), (shape.x2, shape.y2)
        for start, end in pairwise([*_arc(*ends, (shape.cx, shape.cy), shape.clockwise), ends[1]]):
            yield _stroke(start, end, shape.width / 2)
    else:
        line: list[tuple[float, float]] = []
        for start, end, (clockwise, centre) in shape.segments:
            line += [start] if clockwise is None else _arc(start, end, centre, clockwise)
        yield line


def _stroke(start: tuple[float, float], end: tuple[float, float], radius: float) -> list[tuple[float, float]]:
    """Return the outline of what a round pen draws from one point to another."""
    (x1, y1), (x2, y2), length = start, end, math.dist(start, end)
    across, up = ((y2 - y1) / length * radius, (x1 - x2) / length * radius) if length else (0.0, -radius)
    return [*_arc((x1 - across, y1 - up), (x1 + across, y1 + up), start, False),
            *_arc((x2 + across, y2 + up), (x2 - across, y2 - up), end, False)]


def _arc(start: tuple[float, float], end: tuple[float, float], centre: tuple[float, float], clockwise: bool) -> list[tuple[float, float]]:
    """Return points of an arc, without its end."""
    (x, y), radius = centre, math.dist(start, centre)
    first, last = (math.atan2(point[1] - y, point[0] - x) for point in (start, end))
    sweep = (first - last if clockwise else last - first) % (2 * math.pi) or 2 * math.pi
    angles = first + (-sweep if clockwise else sweep) * np.linspace(0, 1, max(2, round(TURN_STEPS * sweep / 2 / math.pi)), endpoint=False)
    return [(x + radius * math.cos(angle), y + radius * math.sin(angle)) for angle in angles]


def _touching(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Return groups of objects, by their boxes [n, 2], that overlap or touch."""
    pairs = [(first, second) for first in range(len(low))
             for second in np.nonzero((low[first] <= high).all(axis=1) & (high[first] >= low).all(axis=1))[0]]
    rows, cols = np.array(pairs).T
    _, group = connected_components(coo_array((np.ones(len(rows)), (rows, cols)), shape=(len(low), len(low))))
    order = np.argsort(group, kind="stable")
    return np.split(order, np.nonzero(np.diff(group[order]))[0] + 1)


def _pads(members: np.ndarray, objects: list[tuple[list[tuple[np.ndarray, bool]], dict[str, Any]]], low: np.ndarray, high: np.ndarray
          ) -> list[Pad]:
    """Return the openings that a group of objects leaves."""
    corner, size = low[members].min(axis=0), np.ptp(np.concatenate([low[members], high[members]]), axis=0)
    cols, rows = np.minimum(SAMPLES * np.ceil(size / (high - low)[members].min(axis=0)), MOST_SAMPLES).astype(int)
    step = size / (cols, rows)
    x, y = corner[0] + (np.arange(cols) + 0.5) * step[0], corner[1] + (np.arange(rows) + 0.5) * step[1]
    image, owner = np.zeros((rows, cols), dtype=bool), np.zeros((rows, cols), dtype=np.int64)
    for member in sorted(members):
        for line, dark in objects[member][0]:
            inside = _inside(line, x, y)
            image[inside], owner[inside] = dark, member
    labels, _ = label(image, structure=np.ones((3, 3)))
    pads = []
    for number, where in enumerate(find_objects(labels), start=1):
        part = labels[where] == number
        attributes = objects[int(np.bincount(owner[where][part]).argmax())][1]
        named: tuple[str, ...] = attributes.get(".P") or attributes.get(".C") or ()
        low_m = corner + np.array([where[1].start, where[0].start]) * step
        pads.append(Pad(named[0] if named else None, named[1] if len(named) > 1 else None, low_m, step, part))
    return pads


def _inside(line: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return whether an outline, [n, 2], holds the points of a grid, [y, x] bool, by the crossings of each row."""
    after = np.roll(line, -1, axis=0)
    out = np.zeros((len(y), len(x)), dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (after[:, 0] - line[:, 0]) / (after[:, 1] - line[:, 1])
    first, last = np.searchsorted(y, [line[:, 1].min(), line[:, 1].max()])
    for row in range(first, last):
        crossed = (line[:, 1] <= y[row]) != (after[:, 1] <= y[row])
        at = np.sort(line[crossed, 0] + (y[row] - line[crossed, 1]) * slope[crossed])
        out[row] = np.searchsorted(at, x) % 2 == 1
    return out
