"""The image stack of a capture: a memory-mapped cache of half values, planar and light-major, which is read in pixel bands.

Layout of `stack-<key>.npy`: [channel, light padded to a multiple of 8, pixel padded to a multiple of 64] half. Each light has
a power-of-two scale of its own, so that half covers it from its brightest value down 29 stops: radiance = stored · scale[light].
Beside it lie `stack-<key>.saturated.npy`, [light / 8, pixel] uint8, whose bit l % 8 (least significant first) is set where light l
has no usable reading (it saturates, or alignment lost it), and the index `stack-<key>.json`, with checksums of all three. Padding is 0.
"""

import json
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stage.errors import StorageError, storage
from stage.files import write_text
from stage.stack import stack_checksums

CHANNELS = 3
"""Red, green and blue."""
LIGHT_PAD = 8
"""The count of lights is padded to this multiple, which matrix units need (docs/figures.md), and eight bits make a byte."""
PIXEL_PAD = 64
"""The count of pixels is padded to this multiple, so that a band divides into whole packs (32 pixels on the CPU, 4 on CUDA)."""
BAND_BYTES = 256 << 20
"""The bytes of the stack in one band, which bound the memory of every solver."""
PAGE_BYTES, PICK_BYTES = 64 << 10, 64 << 20
"""Bytes that a scattered read brings into memory, since Linux maps the 16 cached pages around it, and the limit on such bytes that a pick
keeps in memory at one time."""
LARGEST = np.float32(65504)
"""Largest half value."""


def padded(count: int, multiple: int) -> int:
    """Return the least multiple of `multiple` that is not below `count`."""
    return -(-count // multiple) * multiple


HEADER_BYTES = 256
"""More than the header of a file of a stack has: NumPy pads it to a multiple of 64 bytes."""


@dataclass(frozen=True)
class Stack:
    """The stack of an ingested capture. Every read maps the file again, so that the pages of a finished band leave the process."""

    folder: Path
    key: str
    frames: tuple[str, ...]
    """The image of each light, in manifest order."""
    scale: np.ndarray  # [lights padded] float32, radiance of a stored 1.0; 0 for padding
    pixel_count: int
    motion: dict[str, Any] | None = None
    """The statistics of an aligned stack for the report, or None."""
    clipped: dict[str, int] = field(default_factory=dict, kw_only=True)
    """The number of pixels in which values below the noise were set to 0, by the names of the images that had any."""
    peaks: dict[str, Any] = field(default_factory=dict, kw_only=True)
    """The highest readings of some frames, as `stage.stack.peaks` keeps them."""

    @property
    def light_count(self) -> int:
        """The count of lights, without padding."""
        return len(self.frames)

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of the values: channels, padded count of lights, padded count of pixels."""
        return (CHANNELS, padded(self.light_count, LIGHT_PAD), padded(self.pixel_count, PIXEL_PAD))

    def bands(self, bytes_per_pixel: int = 0) -> Iterator[tuple[int, int]]:
        """Yield pixel ranges [start, stop) that cover the padded pixel axis, each a multiple of 64 pixels."""
        channels, lights, pixels = self.shape
        per_pixel = 2 * channels * lights + bytes_per_pixel
        step = max(PIXEL_PAD, BAND_BYTES // per_pixel // PIXEL_PAD * PIXEL_PAD)
        for start in range(0, pixels, step):
            yield start, min(start + step, pixels)

    def band(self, start: int, stop: int) -> np.ndarray:
        """Return the stored values of a pixel range.
        Returns [3, lights padded, stop - start] float16, a view of a fresh read-only map; radiance = value · scale[light]. Raises
        StorageError if the cache was removed or is truncated."""
        return self._map(values_path(self.folder, self.key), self.shape, np.float16)[:, :, start:stop]

    def saturated(self, start: int, stop: int) -> np.ndarray:
        """Return the saturation bits of a pixel range: [lights padded / 8, stop - start] uint8; bit l % 8 of byte l // 8 is set where light
        l has no usable reading."""
        path = saturated_path(self.folder, self.key)
        shape = (self.shape[1] // 8, self.shape[2])
        if not path.exists():
            return np.zeros((shape[0], stop - start), dtype=np.uint8)
        return self._map(path, shape, np.uint8)[:, start:stop]

    def pick(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the stored values and saturation bits of single pixels.
        `pixels`: [n] row-major indices. Returns [3, lights padded, n] float16 and [lights padded / 8, n] uint8, copies."""
        channels, lights, count = self.shape
        values = np.empty((channels * lights, len(pixels)), dtype=np.float16)
        touched = max(1, min(PAGE_BYTES * len(pixels), 2 * count))
        at_once = max(1, PICK_BYTES // touched)  # scattered reads keep pages in the process as long as the map lives
        for first in range(0, len(values), at_once):
            planes = self._map(values_path(self.folder, self.key), self.shape, np.float16).reshape(len(values), count)
            values[first : first + at_once] = planes[first : first + at_once, pixels]
        return values.reshape(channels, lights, len(pixels)), self.pick_saturated(pixels)

    def pick_radiance(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the radiance of single pixels, and which readings are usable.
        Returns [lights, n, 3] float64 scene-linear and [lights, n] bool, without padding."""
        count = self.light_count
        values, bits = self.pick(pixels)
        radiance = np.moveaxis(values[:, :count].astype(np.float64), 0, -1) * self.scale[:count, None, None]
        return radiance, np.unpackbits(bits, axis=0, bitorder="little")[:count] == 0

    def pick_saturated(self, pixels: np.ndarray) -> np.ndarray:
        """Return the saturation bits of single pixels. Returns [lights padded / 8, n] uint8, a copy."""
        rows = self.shape[1] // 8
        if not saturated_path(self.folder, self.key).exists():
            return np.zeros((rows, len(pixels)), dtype=np.uint8)
        return np.stack([self.saturated(0, self.shape[2])[row, pixels] for row in range(rows)])

    def _map(self, path: Path, shape: tuple[int, ...], dtype: type[np.generic]) -> np.ndarray:
        """Map a file of the stack, in NumPy's format. Its header is compared as text: NumPy would parse it as Python at each call,
        and CPython 3.11 fails where a kernel is parsed in another thread meanwhile."""
        with storage("read", path):
            with open(path, "rb") as file:
                head = file.read(HEADER_BYTES)
            begin = 10 + int.from_bytes(head[8:10], "little")
            described = f"'descr': '{np.dtype(dtype).str}', 'fortran_order': False, 'shape': {shape}".encode()
            if not head.startswith(b"\x93NUMPY\x01\x00") or described not in head[10:begin]:
                raise StorageError(f"{path}: the cache is damaged: delete it and run again")
            try:
                return np.memmap(path, dtype=dtype, mode="r", offset=begin, shape=shape)
            except ValueError as error:  # it ends too early
                raise StorageError(f"{path}: the cache is damaged: delete it and run again") from error


def values_path(folder: Path, key: str) -> Path:
    """Return the path of the half values of a stack."""
    return folder / f"stack-{key}.npy"


def saturated_path(folder: Path, key: str) -> Path:
    """Return the path of the saturation bits of a stack; the file is absent when no reading saturates."""
    return folder / f"stack-{key}.saturated.npy"


def index_path(folder: Path, key: str) -> Path:
    """Return the path of the index of a stack, which is written last: a stack without an index is incomplete."""
    return folder / f"stack-{key}.json"


def find(folder: Path, key: str) -> Stack | None:
    """Return the complete and undamaged stack of a key, or None. A damaged stack is removed, so that it is made again."""
    if not index_path(folder, key).exists():
        return None
    try:
        index = json.loads(index_path(folder, key).read_text(encoding="utf-8"))
        checksum = index.pop("checksum")
        found = Stack(folder, key, tuple(index["frames"]), np.array(index["scale"], dtype=np.float32), int(index["pixel_count"]),
                      index.get("motion"), clipped=index.get("clipped", {}), peaks=index.get("peaks", {}))
        saturated = index["checksums"]["saturated"]
        bits = saturated_path(folder, key)
        sound = (checksum == _checksum(index)
                 and stack_checksums.is_sound(values_path(folder, key), found.shape, np.float16, index["checksums"]["values"])
                 and (not bits.exists() if saturated is None else
                      stack_checksums.is_sound(bits, (found.shape[1] // 8, found.shape[2]), np.uint8, [saturated])))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        sound = False
    if not sound:
        remove(folder, key)
        return None
    return found


def write_index(stack: Stack, values: Sequence[int], saturated: int | None) -> None:
    """Write the index of a stack, which completes it.
    `values`: the checksums of its planes, in the order of channels and padded lights. `saturated`: the checksum of the saturation bits, or
    None where there are none."""
    index = {"frames": stack.frames, "scale": [float(scale) for scale in stack.scale], "pixel_count": stack.pixel_count,
             "motion": stack.motion, "clipped": stack.clipped, "peaks": stack.peaks,
             "checksums": {"values": list(values), "saturated": saturated}}
    write_text(index_path(stack.folder, stack.key), json.dumps(index | {"checksum": _checksum(index)}))


def remove(folder: Path, key: str) -> None:
    """Remove a stack from the cache, its index first, so that a partly removed stack is never found."""
    for path in (index_path(folder, key), values_path(folder, key), saturated_path(folder, key)):
        path.unlink(missing_ok=True)


def _checksum(index: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(index, sort_keys=True).encode())


@dataclass(frozen=True)
class ReplacedStack(Stack):
    """A stack with other values for some readings; the saturation bits are those of the recorded stack."""

    recorded: Stack | None = None
    """The stack with the readings that are replaced."""
    pixel: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # [n] row-major positions, ascending
    light: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # [n] of each reading
    radiance: np.ndarray = field(default_factory=lambda: np.zeros((3, 0), dtype=np.float32))  # [3, n] in place of each reading

    @classmethod
    def of(
        cls, stack: Stack,
        pixel: np.ndarray,  # [n] row-major positions in the image
        light: np.ndarray,  # [n] positions in the stack
        radiance: np.ndarray,  # [3, n]
    ) -> "ReplacedStack":
        """Return a stack with these readings in place of its own."""
        order = np.argsort(pixel, kind="stable")
        scale = stack.scale.copy()
        largest = np.zeros(len(scale))
        np.maximum.at(largest, light, radiance.max(axis=0, initial=0))
        over = largest > LARGEST * scale
        scale[over] = np.exp2(np.ceil(np.log2(largest[over] / LARGEST)))
        return cls(stack.folder, stack.key, stack.frames, scale, stack.pixel_count, stack.motion, stack, pixel[order], light[order],
                   radiance[:, order].astype(np.float32))

    def band(self, start: int, stop: int) -> np.ndarray:
        """Return the values of a pixel range, [3, lights padded, stop - start] float16."""
        assert self.recorded is not None
        span = slice(*np.searchsorted(self.pixel, (start, stop)))
        return self._placed(self.recorded.band(start, stop), span, self.pixel[span] - start)

    def saturated(self, start: int, stop: int) -> np.ndarray:
        """Return the bits of the recorded readings, [lights padded / 8, stop - start] uint8."""
        assert self.recorded is not None
        return self.recorded.saturated(start, stop)

    def pick(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values [3, lights padded, n] float16 and bits [lights padded / 8, n] uint8 of single pixels, each given once."""
        assert self.recorded is not None
        values, bits = self.recorded.pick(pixels)
        order = np.argsort(pixels, kind="stable")
        place = np.minimum(np.searchsorted(pixels[order], self.pixel), len(pixels) - 1)
        among = np.flatnonzero(pixels[order][place] == self.pixel)
        return self._placed(values, among, order[place[among]]), bits

    def pick_saturated(self, pixels: np.ndarray) -> np.ndarray:
        """Return the bits of single pixels, [lights padded / 8, n] uint8."""
        assert self.recorded is not None
        return self.recorded.pick_saturated(pixels)

    def _placed(self, values: np.ndarray, readings: slice | np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return values with some of the replaced readings in these columns."""
        assert self.recorded is not None
        placed = np.array(values)
        light = self.light[readings]
        for other in np.flatnonzero(self.scale != self.recorded.scale):
            placed[:, other] = values[:, other].astype(np.float32) * (self.recorded.scale[other] / self.scale[other])
        placed[:, light, column] = self.radiance[:, readings] / self.scale[light]
        return placed
