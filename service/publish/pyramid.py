"""A picture as tiles of every zoom, written while its rows come from the top, so that no picture is held whole."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from service.errors import RequestError

TILE = 256
"""The side of a tile, pixels; even, so that halves of neighbouring tiles meet."""
LONGEST_SIDE = 65500
"""The longest side of a JPEG file, less a reserve."""

TilePath = Callable[[int, int, int], Path]
"""Returns the path of a tile from how often the picture was halved, and the column and row of the tile."""


def halvings(width: int, height: int, side: int) -> int:
    """Return how often a picture must be halved, rounding up, until neither of its sides is longer than `side`."""
    count = 0
    while max(-(-width >> count), -(-height >> count)) > side:
        count += 1
    return count


def size_at(width: int, height: int, halving: int) -> tuple[int, int]:
    """Return width and height of a picture after some halvings, each rounded up."""
    return -(-width // (1 << halving)), -(-height // (1 << halving))


class Pyramid:
    """Writes the tiles of one picture as JPEG files without subsampled colour: coefficients are no colours."""

    def __init__(self, width: int, height: int, tile: TilePath, *, levels: int, quality: int, whole: Path | None = None,
                 small: Callable[[int, np.ndarray], None] | None = None, small_side: int = 0) -> None:
        """Begin a picture.

        Args:
            levels: number of zooms; each halves the one before.
            whole: the file of the whole picture; None: there is none.
            small: takes the whole image [rows, cols, 3] of each zoom whose sides are at most `small_side`, with its number of halvings.
        """
        self._tile, self._quality, self._small = tile, quality, small
        self._pending: list[list[np.ndarray]] = [[] for _ in range(levels)]
        self._rows = [0] * levels  # that have been written
        self._kept: dict[int, list[np.ndarray]] = {k: [] for k in range(levels) if max(size_at(width, height, k)) <= small_side}
        self._whole, self._written = None if whole is None else _open(whole, width, height, quality), 0

    def append(self, rows: np.ndarray) -> None:
        """Take further rows, [rows, width, 3] uint8; only the last may be others than a multiple of the side of a tile."""
        if self._whole is not None:
            if not self._whole.write_scanlines(self._written, self._written + len(rows), 0, np.ascontiguousarray(rows)):
                raise OSError(self._whole.geterror())
            self._written += len(rows)
        self._take(0, rows)

    def close(self) -> None:
        """Write what is left, and the small images."""
        for level in range(len(self._pending)):
            if self._pending[level]:
                self._flush(level, np.concatenate(self._pending[level]))
        if self._whole is not None and not self._whole.close():
            raise OSError(self._whole.geterror())
        for level, parts in self._kept.items():
            if self._small is not None:
                self._small(level, np.concatenate(parts))

    def _take(self, level: int, rows: np.ndarray) -> None:
        pending = self._pending[level]
        pending.append(rows)
        if sum(map(len, pending)) < TILE:
            return
        there = np.concatenate(pending) if len(pending) > 1 else rows
        whole = len(there) // TILE * TILE
        self._pending[level] = [there[whole:]] if len(there) > whole else []
        for begin in range(0, whole, TILE):
            self._flush(level, there[begin:begin + TILE])

    def _flush(self, level: int, rows: np.ndarray) -> None:
        """Write a row of tiles, and give its half to the next level."""
        number = self._rows[level] // TILE
        for column in range(-(-rows.shape[1] // TILE)):
            write_jpeg(self._tile(level, column, number), rows[:, column * TILE:(column + 1) * TILE], self._quality)
        self._rows[level] += len(rows)
        if level in self._kept:
            self._kept[level].append(rows)
        if level + 1 < len(self._pending):
            self._take(level + 1, _halved(rows))


def write_jpeg(path: Path, pixels: np.ndarray, quality: int) -> None:
    """Write [rows, cols, 3] uint8 as a JPEG file without subsampled colour."""
    output = _open(path, pixels.shape[1], pixels.shape[0], quality)
    if not (output.write_image(np.ascontiguousarray(pixels)) and output.close()):
        raise OSError(output.geterror())


def _halved(rows: np.ndarray) -> np.ndarray:
    """Return means of 2 × 2 pixels; the last row and column stand twice where their number is odd."""
    odd = [(0, len(rows) % 2), (0, rows.shape[1] % 2), (0, 0)]
    even = np.pad(rows, odd, mode="edge").astype(np.uint16)
    return ((even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2] + 2) >> 2).astype(np.uint8)


def _open(path: Path, width: int, height: int, quality: int) -> oiio.ImageOutput:
    """Open a JPEG file."""
    if max(width, height) > LONGEST_SIDE:
        raise RequestError(f"{path.name}: a JPEG file has sides of at most {LONGEST_SIDE} pixels, the images have {width}x{height}: "
                           "publish a part with --crop, or --as web, which has tiles alone")
    path.parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(width, height, 3, oiio.UINT8)
    spec.attribute("compression", f"jpeg:{quality}")
    spec.attribute("jpeg:subsampling", "4:4:4")
    output = oiio.ImageOutput.create(str(path))
    if output is None or not output.open(str(path), spec):
        raise OSError(oiio.geterror() if output is None else output.geterror())
    return output
