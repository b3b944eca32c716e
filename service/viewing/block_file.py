"""view.bin: blocks of little-endian values one after another, each found by its offset and length."""

import zlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import numpy as np

from kernels import device as devices

LEVEL = 4
"""Level of DEFLATE: half values and normals are noise in their low bits, and higher levels make the file 2 % smaller in four times the
time."""
AT_ONCE = 64
"""Number of blocks that are compressed at one time, which bounds their memory."""

Place = list[int]
"""Offset and length of a block in the file, bytes."""


class BlockFile:
    """Writes view.bin."""

    def __init__(self, path: Path) -> None:
        """Open the file for writing; what is in it is lost."""
        self._file = open(path, "wb")  # noqa: SIM115 (closed by close)
        self._end = 0
        self._pool = ThreadPoolExecutor(devices.worker_count(), thread_name_prefix="relit-view")

    def close(self) -> None:
        """Close the file."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._file.close()

    def append(self, block: np.ndarray) -> Place:
        """Append an array as one compressed block, and return its place."""
        return next(self.append_all([block]))

    def append_all(self, blocks: Iterable[np.ndarray]) -> Iterator[Place]:
        """Append arrays as compressed blocks, and yield the place of each."""
        waiting = iter(blocks)
        while some := list(islice(waiting, AT_ONCE)):
            for packed in self._pool.map(_compressed, some):
                self._file.seek(self._end)
                self._file.write(packed)
                self._end += len(packed)
                yield [self._end - len(packed), len(packed)]

    def reserve(self, size: int) -> int:
        """Reserve bytes at the end of the file, which `write_at` fills, and return their offset."""
        offset, self._end = self._end, self._end + size
        self._file.truncate(self._end)
        return offset

    def write_at(self, offset: int, values: np.ndarray) -> None:
        """Write values, as they are, into reserved bytes."""
        self._file.seek(offset)
        self._file.write(_little(values).data)


def _little(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))


def _compressed(values: np.ndarray) -> bytes:
    return zlib.compress(_little(values).data, LEVEL)
