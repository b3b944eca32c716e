"""The layers of maps in view.bin and view.json: tiles of every level, range and histogram.

The levels of a layer are the whole image, then one of half the size after another, cut into tiles.

A pixel of a lower level has the mean of those of its four pixels that are solved, else of those that are estimated. Of status codes it has
the worst, and it is in the mask only if all of its pixels are that are on the object: a pixel that is unsure stays visible at every size.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from kernels.status import ESTIMATED, SOLVED, Status
from service.reporting.progress import Timings
from service.viewing.block_file import BlockFile
from service.viewing.result_layers import CODES, MASK, VECTOR, ResultLayers
from stage.results.light_basis import numbers

BINS = 64
RANGE_PERCENTILES = (1, 99)
"""Percentiles of the values that a display maps to black and white at first."""
HISTOGRAM_PERCENTILES = (0.1, 99.9)
"""Percentiles at which a histogram begins and ends, so that a few wild values do not squeeze the rest into one bin."""
TILE = 256
"""Rows and columns of a tile."""
NONE, UNSURE, SURE = range(3)
"""Classes of pixels: without an estimate, with one outside the mask, and in the mask."""
OUTSIDE, IN_MASK, NOT_IN_MASK = range(3)
"""Grades of pixels, the worst last: those outside the object, and those of the object by whether they are in the mask."""
SEVERITY = (Status.UNSOLVED, *SOLVED, Status.UNSURE, Status.UNDECIDED, Status.MULTIPATH, Status.FLYING,
            *(status for status in Status if status not in (Status.UNSOLVED, *ESTIMATED)))
"""Status codes from those that other codes hide to the worst; UNSOLVED is the background, which hides nothing."""


def statistics_of(values: np.ndarray, valid: np.ndarray) -> dict[str, Any]:
    """Return `range` and `histogram` of the valid pixels of a layer [channels, rows, cols]; all are 0 where there is none.

    The range is [1st, 99th percentile] over all channels. The histogram has `low`, `high` and `counts` [channels][64]; values beyond count
    in the first and last bin.
    """
    chosen = values[:, valid].astype(np.float32, copy=False)
    of = (HISTOGRAM_PERCENTILES[0], *RANGE_PERCENTILES, HISTOGRAM_PERCENTILES[1])
    low, first, last, high = (float(value) for value in np.percentile(chosen, of)) if chosen.size else (0.0, 0.0, 0.0, 0.0)
    counts = [np.histogram(np.clip(row, low, high), bins=BINS, range=(low, high))[0].tolist() for row in chosen]
    return {"range": numbers([first, last]), "histogram": {"low": numbers(low), "high": numbers(high), "counts": counts}}


def code_counts(codes: np.ndarray, counted: np.ndarray) -> dict[str, Any]:
    """Return the codes that occur as `range`, and as `histogram` how many of the counted pixels have each code 0 … 63."""
    counts = np.bincount(np.minimum(codes[counted], BINS - 1), minlength=BINS)
    return {"range": np.flatnonzero(np.bincount(codes.reshape(-1))).tolist(),
            "histogram": {"low": 0, "high": BINS, "counts": [counts.tolist()]}}


MEANINGS = {
    Status.UNSOLVED: "Outside the object: nothing was to be solved here.",
    Status.OK: "Solved.",
    Status.TOO_FEW_LIGHTS: "Too few lights gave a usable reading.",
    Status.DARK: "No light gave a reading above the noise.",
    Status.ILL_POSED: "The usable lights lie close to one plane, or all readings are the same: the normal is not determined.",
    Status.NOT_FACING: "The best normal points away from the camera.",
    Status.SATURATED: "Too few usable lights: the others saturate.",
    Status.SHADOWED: "Too few usable lights: the others are in shadow.",
    Status.AMBIGUOUS: "Solved, but the readings leave the normal open by more than five degrees.",
    Status.NOT_CONVERGED: "Solved, but the last round of the solve still moved the result.",
    Status.LOW_MODULATION: "The projected or emitted signal is too weak to be decoded.",
    Status.OUT_OF_RANGE: "Decoded to a place that cannot have been lit, or outside the measured range.",
    Status.UNDECIDED: "The readings fit several depths about equally well.",
    Status.FLYING: "A mixture of two surfaces, taken out by a filter that was asked for.",
    Status.MULTIPATH: "Frequencies or codes disagree: light came over several ways.",
    Status.UNSURE: "Estimated, but less surely than was asked for.",
    Status.OCCLUDED: "One camera sees this place and the other does not, so that there is nothing to triangulate.",
}
"""The meaning of each status, for a person who looks at a pixel."""
REGIMES = {1: "Lambertian", 2: "glossy", 3: "mirror", 4: "mixture of diffuse and specular"}
"""Codes of the layer regime."""


def write_layers(found: ResultLayers, file: BlockFile, timings: Timings) -> list[dict[str, Any]]:
    """Write the tiles of every layer, and return what view.json says of them."""
    names = found.names()
    timings.stage("layers", len(names))
    classes = _class_levels(found)
    described = []
    for done, name in enumerate(names, start=1):
        described.append(_write_layer(found, name, classes, file))
        timings.advance(done)
    return described


def status_codes() -> dict[str, dict[str, Any]]:
    """Return name, meaning and whether a pixel may have values, of every status code."""
    return {str(int(status)): {"name": status.name.lower(), "meaning": MEANINGS[status], "estimate": status in ESTIMATED}
            for status in Status}


def _class_levels(found: ResultLayers) -> list[np.ndarray]:
    levels = [np.where(found.mask, SURE, np.where(found.estimated, UNSURE, NONE)).astype(np.uint8)]
    for _ in level_sizes(*found.mask.shape)[1:]:
        levels.append(halve_classes(levels[-1]))
    return levels


def _write_layer(found: ResultLayers, name: str, classes: list[np.ndarray], file: BlockFile) -> dict[str, Any]:
    shown, values = found.appearance(name), found.take(name)
    stored = values.dtype
    facts: dict[str, Any] = {"name": name, "title": shown.title, "kind": shown.kind, "channels": found.suffixes(name), "unit": shown.unit,
                             "dtype": str(stored)}
    if shown.kind in (CODES, MASK):
        codes = values[0].astype(np.uint8)
        facts |= code_counts(codes, found.on_object)
        if name == "regime":
            facts["codes"] = {str(code): {"name": words} for code, words in REGIMES.items()}
    else:
        facts |= statistics_of(values, found.mask)
    facts["levels"] = []
    for level in _levels(found, name, shown.kind, values, classes):
        rows, cols = level.shape[1:]
        cut = (level[:, tile.rows, tile.cols].astype(stored) for tile in tiles(rows, cols))
        facts["levels"].append({"rows": rows, "cols": cols, "tile": TILE, "tiles": list(file.append_all(cut))})
    return facts


def _levels(found: ResultLayers, name: str, kind: str, values: np.ndarray, classes: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the levels of a layer, each [channels, rows, cols]."""
    if kind == MASK:
        yield from (grade == IN_MASK for grade in _codes(mask_grades(found.mask, found.on_object)[None], classes,
                                                                 halve_numbers))
    elif kind == CODES:
        yield from _codes(values, classes, halve_status if name == "status" else halve_numbers)
    else:
        halve = halve_vectors if kind == VECTOR else halve_values
        yield values
        for each in classes[:-1]:
            values = halve(values, each)
            yield values


def _codes(codes: np.ndarray, classes: list[np.ndarray], halve: Callable[[np.ndarray], np.ndarray]) -> Iterator[np.ndarray]:
    """Yield codes [1, rows, cols], and those of every further level."""
    yield codes
    for _ in classes[:-1]:
        codes = halve(codes)
        yield codes


class Tile(NamedTuple):
    """The rows and columns of its level that a tile covers."""

    rows: slice
    cols: slice


def level_sizes(rows: int, cols: int) -> list[tuple[int, int]]:
    """Return rows and columns of every level: the image, then halves, rounded up, until one fits into a tile."""
    sizes = [(rows, cols)]
    while max(sizes[-1]) > TILE:
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    return sizes


def tiles(rows: int, cols: int) -> Iterator[Tile]:
    """Yield the tiles of a level row by row; those at the edges are as small as the level ends."""
    for row in range(0, rows, TILE):
        for col in range(0, cols, TILE):
            yield Tile(slice(row, min(row + TILE, rows)), slice(col, min(col + TILE, cols)))


def halve_classes(classes: np.ndarray) -> np.ndarray:
    """Return the best class [rows, cols] of each four pixels."""
    return np.maximum.reduce(_quarters(classes))


def halve_values(values: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Return the mean of the pixels of the best class among each four, [channels, ⌈rows / 2⌉, ⌈cols / 2⌉] float32; 0 without estimate."""
    corners = _quarters(classes)
    best = np.maximum.reduce(corners)
    counted = [(corner == best) & (best > NONE) for corner in corners]
    count = np.maximum(np.add.reduce([each.astype(np.float32) for each in counted]), 1)
    halved = np.zeros((len(values), *best.shape), dtype=np.float32)
    for channel, plane in enumerate(values):
        for quarter, each in zip(_quarters(plane), counted, strict=True):
            np.add(halved[channel], quarter, out=halved[channel], where=each)
        halved[channel] /= count
    return halved


def halve_vectors(values: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Return as `halve_values`, with the means of unit vectors made unit vectors again."""
    halved = halve_values(values, classes)
    length = np.sqrt(np.einsum("crq,crq->rq", halved, halved))
    return np.divide(halved, length, out=halved, where=length > 0)


def mask_grades(mask: np.ndarray, on_object: np.ndarray) -> np.ndarray:
    """Return the grade of each pixel, [rows, cols] uint8; at lower levels `halve_numbers` gives the worst of each four."""
    return np.where(mask, IN_MASK, np.where(on_object, NOT_IN_MASK, OUTSIDE)).astype(np.uint8)


def halve_status(codes: np.ndarray) -> np.ndarray:
    """Return the worst status [1, rows, cols] of each four pixels, by SEVERITY."""
    worst = np.maximum.reduce(_quarters(np.argsort(SEVERITY)[codes[0].astype(np.intp)]))
    return np.array(SEVERITY, dtype=np.float32)[worst][None]


def halve_numbers(codes: np.ndarray) -> np.ndarray:
    """Return the largest number [1, rows, cols] of each four pixels."""
    return np.asarray(np.maximum.reduce(_quarters(codes[0])))[None]


def _quarters(plane: np.ndarray) -> list[np.ndarray]:
    """Return the upper left, upper right, lower left and lower right pixel of each four; where the image ends, 0."""
    padded = np.pad(plane, ((0, plane.shape[0] % 2), (0, plane.shape[1] % 2)))
    return [padded[row::2, col::2] for row in (0, 1) for col in (0, 1)]
