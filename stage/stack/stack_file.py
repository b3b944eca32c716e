"""The file of the half values of a stack while it is written, an image at a time and in any order."""

import io
import math
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stage.stack import stack_checksums
from stage.stack.correction import CodedRadiance, Radiance
from stage.stack.stack import CHANNELS, LIGHT_PAD, PIXEL_PAD, padded

LOOK_UP_CODES = 1 << 16
"""Codes that are looked up at one time: their positions are half a megabyte, which stays in the second-level cache."""
LARGEST_FACTOR = 126
"""Exponents below this make a factor that is a normal float32, with which a product is exact; `ldexp` takes eight times as long."""
TOP_EXPONENT = 15
"""The brightest value of a light is stored in [2^14, 2^15): below 65504, the largest half, with 29 stops of normal values."""


class StackFile:
    """A file with the layout of a stack, whose planes are 0 until they are written; lights may be written by several threads."""

    def __init__(self, path: Path, light_count: int, pixel_count: int) -> None:
        """Make the file, write its header and reserve its space, so that a full disk is known at once; raises OSError."""
        lights, pixels = padded(light_count, LIGHT_PAD), padded(pixel_count, PIXEL_PAD)
        self._pixels, self._count, self._lock = pixels, pixel_count, threading.Lock()
        self._padding = 2 * (pixels - pixel_count)
        self._marked: set[int] = set()  # lights that have a saturation bit
        self.scale = np.zeros(lights, dtype=np.float32)
        """[lights padded], the radiance of a stored 1.0."""
        empty = stack_checksums.of_plane(np.zeros(pixel_count, dtype=np.float16), self._padding)
        self.checksums = np.full((CHANNELS, lights), empty)
        """[channels, lights padded], of the planes."""
        self.saturated = np.zeros((lights // 8, pixels), dtype=np.uint8)
        """The saturation bits, as a stack has them."""
        self._file = io.FileIO(path, "w+")
        try:
            np.lib.format.write_array_header_1_0(
                self._file, {"descr": "<f2", "fortran_order": False, "shape": (CHANNELS, lights, pixels)})
            self._start = self._file.tell()
            _reserve(self._file.fileno(), self._start + self.size(light_count, pixel_count))
        except BaseException:
            self._file.close()
            raise

    @staticmethod
    def size(light_count: int, pixel_count: int) -> int:
        """Return the bytes of such a file, without its header."""
        return 2 * CHANNELS * padded(light_count, LIGHT_PAD) * padded(pixel_count, PIXEL_PAD)

    def write(self, light: int, radiance: Radiance | CodedRadiance) -> None:
        """Write the planes of a light, in place of those that it had."""
        planes, self.scale[light] = half_planes(radiance)
        for channel, plane in enumerate(planes):
            self.checksums[channel, light] = stack_checksums.of_plane(plane, self._padding)
            _write_all(self._file.fileno(), plane, self._start + 2 * (channel * len(self.scale) + light) * self._pixels)
        row, bit = self.saturated[light // 8, :self._count], np.uint8(1 << light % 8)
        with self._lock:  # eight lights share a byte
            if light in self._marked:
                row &= ~bit
            if radiance.saturated is not None and radiance.saturated.any():
                self._marked.add(light)
                row |= radiance.saturated.reshape(-1).astype(np.uint8) * bit

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def half_planes(radiance: Radiance | CodedRadiance) -> tuple[Iterator[np.ndarray], float]:
    """Return the half planes of the channels of an image, [pixels] each, and the radiance of a stored 1.0, a power of two so that half
    images keep their bits."""
    values: np.ndarray
    if isinstance(radiance, CodedRadiance):
        codes, values = radiance.codes, radiance.values
        least, most = int(codes.min()), int(codes.max())
        # where codes are the bits of half values, `most` is the lowest value below zero if there is one, and this the highest
        signed = int(codes.view(np.int16).max()) % len(values) if codes.dtype == np.uint16 else most
        present = values[[least, most, signed]]
    else:
        codes, values = None, radiance.pixels
        present = values
    peak = max(float(present.max()), -float(present.min()))
    exponent = math.frexp(peak)[1] - TOP_EXPONENT if peak else 0

    def planes() -> Iterator[np.ndarray]:
        if codes is None:
            for channel in range(CHANNELS):
                yield _scaled(values[..., channel], exponent).reshape(-1)
            return
        half = _scaled(values, exponent)
        for channel in range(CHANNELS):
            yield _look_up(half, codes[..., channel])

    return planes(), math.ldexp(1.0, exponent)


def _scaled(values: np.ndarray, exponent: int) -> np.ndarray:
    """Return values divided by a power of two as half; those of codes that the image does not have may overflow."""
    factor = np.float32(math.ldexp(1.0, -exponent)) if abs(exponent) < LARGEST_FACTOR else None
    with np.errstate(over="ignore"):
        return (np.ldexp(values, -exponent) if factor is None else values * factor).astype(np.float16)


def _look_up(table: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return the entries of a table for codes, [codes], a piece at a time: NumPy makes 64-bit positions of all codes that it is given."""
    flat = np.ascontiguousarray(codes).reshape(-1)
    found = np.empty(len(flat), dtype=table.dtype)
    for first in range(0, len(flat), LOOK_UP_CODES):
        piece = slice(first, first + LOOK_UP_CODES)
        np.take(table, flat[piece], out=found[piece], mode="clip")  # checks of the range would make a copy
    return found


def _write_all(descriptor: int, plane: np.ndarray, offset: int) -> None:
    """Write a plane with pwrite; a full disk is an error here, whereas a write to a mapped file would kill the process."""
    view = memoryview(plane.data).cast("B")
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def _reserve(descriptor: int, size: int) -> None:
    """Reserve the space of the stack before the first frame is decoded, so that a full disk is known at once."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        os.ftruncate(descriptor, size)
