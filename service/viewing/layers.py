"""The layers of maps in view.bin and view.json: tiles of every level, range and histogram."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from kernels.status import ESTIMATED, Status
from service.reporting.progress import Timings
from service.viewing import pyramid
from service.viewing.block_file import BlockFile
from service.viewing.result_layers import CODES, MASK, VECTOR, ResultLayers
from stage.results.light_basis import numbers

BINS = 64
RANGE_PERCENTILES = (1, 99)
"""Percentiles of the values that a display maps to black and white at first."""
HISTOGRAM_PERCENTILES = (0.1, 99.9)
"""Percentiles at which a histogram begins and ends, so that a few wild values do not squeeze the rest into one bin."""


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
    Status.DARK: "No light gave a reading above zero.",
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
    """Return the class of every pixel of every level."""
    levels = [np.where(found.mask, pyramid.SURE, np.where(found.estimated, pyramid.UNSURE, pyramid.NONE)).astype(np.uint8)]
    for _ in pyramid.level_sizes(*found.mask.shape)[1:]:
        levels.append(pyramid.halve_classes(levels[-1]))
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
        cut = (level[:, tile.rows, tile.cols].astype(stored) for tile in pyramid.tiles(rows, cols))
        facts["levels"].append({"rows": rows, "cols": cols, "tile": pyramid.TILE, "tiles": list(file.append_all(cut))})
    return facts


def _levels(found: ResultLayers, name: str, kind: str, values: np.ndarray, classes: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the levels of a layer, each [channels, rows, cols]."""
    if kind == MASK:
        yield from (grade == pyramid.IN_MASK for grade in _codes(pyramid.mask_grades(found.mask, found.on_object)[None], classes,
                                                                 pyramid.halve_numbers))
    elif kind == CODES:
        yield from _codes(values, classes, pyramid.halve_status if name == "status" else pyramid.halve_numbers)
    else:
        halve = pyramid.halve_vectors if kind == VECTOR else pyramid.halve_values
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
