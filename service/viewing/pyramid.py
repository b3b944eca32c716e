"""The levels of a layer: the whole image, then one of half the size after another, cut into tiles.

A pixel of a lower level has the mean of those of its four pixels that are solved, else of those that are estimated. Of status codes it has
the worst, and it is in the mask only if all of its pixels are that are on the object: a pixel that is unsure stays visible at every size.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from kernels.status import ESTIMATED, SOLVED, Status

TILE = 256
"""Rows and columns of a tile."""
NONE, UNSURE, SURE = range(3)
"""Classes of pixels: without an estimate, with one outside the mask, and in the mask."""
OUTSIDE, IN_MASK, NOT_IN_MASK = range(3)
"""Grades of pixels, the worst last: those outside the object, and those of the object by whether they are in the mask."""
SEVERITY = (Status.UNSOLVED, *SOLVED, Status.UNSURE, Status.UNDECIDED, Status.MULTIPATH, Status.FLYING,
            *(status for status in Status if status not in (Status.UNSOLVED, *ESTIMATED)))
"""Status codes from those that other codes hide to the worst; UNSOLVED is the background, which hides nothing."""


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
