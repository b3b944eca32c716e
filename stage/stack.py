"""The image stack of a capture as a memory-mapped cache: half, planar, light-major, read in pixel bands.

Layout of `stack-<key>.npy`: [channel, light padded to a multiple of 8, pixel padded to a multiple of 64] half. Each light has
a power-of-two scale of its own, so that half covers it from its brightest value down 29 stops: radiance = stored · scale[light].
Beside it `stack-<key>.saturated.npy` [light / 8, pixel] uint8 (bit l % 8, least significant first) where there is no reading
(it saturates, or alignment has none) and `stack-<key>.json`. A padded light or pixel is 0.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stage.errors import StorageError, storage

CHANNELS = 3
LIGHT_PAD = 8
"""Lights are padded to this multiple: matrix units want it (docs/figures.md), and one byte holds eight saturation bits."""
PIXEL_PAD = 64
"""Pixels are padded to this multiple, so that a band always divides into whole packs (32 on the CPU, 4 on CUDA)."""
BAND_BYTES = 256 << 20
"""How much of the stack one band holds: what bounds the memory of every solver."""


def padded(count: int, multiple: int) -> int:
    """The next multiple."""
    return -(-count // multiple) * multiple


@dataclass(frozen=True)
class Stack:
    """An ingested capture. Every read maps the file anew, so that the pages of a finished band leave the process."""

    folder: Path
    key: str
    frames: tuple[str, ...]
    """Image name of each light, in manifest order."""
    scale: np.ndarray  # [lights padded] float32, radiance of a stored 1.0; 0 for padding
    pixel_count: int
    motion: dict[str, Any] | None = None
    """Of an aligned stack, how the subject moved, as the report says it."""

    @property
    def light_count(self) -> int:
        """Lights, without padding."""
        return len(self.frames)

    @property
    def shape(self) -> tuple[int, int, int]:
        """[channel, light padded, pixel padded]."""
        return (CHANNELS, padded(self.light_count, LIGHT_PAD), padded(self.pixel_count, PIXEL_PAD))

    def bands(self, bytes_per_pixel: int = 0) -> Iterator[tuple[int, int]]:
        """Pixel ranges [start, stop) that cover the padded pixel axis; each a multiple of 64 long.

        Args:
            bytes_per_pixel: what the caller allocates beside the stack for each pixel; 0 for little.
        """
        channels, lights, pixels = self.shape
        per_pixel = 2 * channels * lights + bytes_per_pixel
        step = max(PIXEL_PAD, BAND_BYTES // per_pixel // PIXEL_PAD * PIXEL_PAD)
        for start in range(0, pixels, step):
            yield start, min(start + step, pixels)

    def band(self, start: int, stop: int) -> np.ndarray:
        """The stored values of a pixel range.

        Returns:
            [3, lights padded, stop - start] float16, a view of a fresh read-only map; radiance = value · scale[light].

        Raises:
            StorageError: the cache is gone or was cut short.
        """
        return self._map(values_path(self.folder, self.key), self.shape)[:, :, start:stop]

    def saturated(self, start: int, stop: int) -> np.ndarray:
        """Which readings of a pixel range saturate.

        Returns:
            [lights padded / 8, stop - start] uint8, bit l % 8 of byte l // 8.
        """
        path = saturated_path(self.folder, self.key)
        shape = (self.shape[1] // 8, self.shape[2])
        if not path.exists():
            return np.zeros((shape[0], stop - start), dtype=np.uint8)
        return self._map(path, shape)[:, start:stop]

    def pick(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The stored values and saturation bits of single pixels.

        Args:
            pixels: [n] positions, row-major.

        Returns:
            [3, lights padded, n] float16 and [lights padded / 8, n] uint8, copies.
        """
        channels, lights, _ = self.shape
        values = np.empty((channels, lights, len(pixels)), dtype=np.float16)
        for channel, light in np.ndindex(channels, lights):  # a map each: scattered reads leave a page or more in the process
            values[channel, light] = self._map(values_path(self.folder, self.key), self.shape)[channel, light, pixels]
        return values, self.pick_saturated(pixels)

    def pick_saturated(self, pixels: np.ndarray) -> np.ndarray:
        """The saturation bits of single pixels.

        Args:
            pixels: [n] positions, row-major.

        Returns:
            [lights padded / 8, n] uint8, a copy.
        """
        rows = self.shape[1] // 8
        if not saturated_path(self.folder, self.key).exists():
            return np.zeros((rows, len(pixels)), dtype=np.uint8)
        return np.stack([self.saturated(0, self.shape[2])[row, pixels] for row in range(rows)])

    def _map(self, path: Path, shape: tuple[int, ...]) -> np.ndarray:
        with storage("read", path):
            try:
                values = np.load(path, mmap_mode="r")
            except (ValueError, EOFError) as error:
                raise StorageError(f"{path}: the cache is damaged: delete it and run again") from error
        if values.shape != shape:
            raise StorageError(f"{path}: the cache is damaged: delete it and run again")
        return values


def values_path(folder: Path, key: str) -> Path:
    """Where the half values of a stack lie."""
    return folder / f"stack-{key}.npy"


def saturated_path(folder: Path, key: str) -> Path:
    """Where its saturation bits lie; absent when no reading saturates."""
    return folder / f"stack-{key}.saturated.npy"


def index_path(folder: Path, key: str) -> Path:
    """Where its index lies, written last: a stack without an index is not there."""
    return folder / f"stack-{key}.json"


def find(folder: Path, key: str) -> Stack | None:
    """The finished stack of this key, or None."""
    try:
        index = json.loads(index_path(folder, key).read_text(encoding="utf-8"))
        found = Stack(folder, key, tuple(index["frames"]), np.array(index["scale"], dtype=np.float32), int(index["pixel_count"]),
                      index.get("motion"))
    except (OSError, ValueError, KeyError, TypeError):  # a cache, and a damaged one: built again
        return None
    if not values_path(folder, key).exists():
        return None
    return found
