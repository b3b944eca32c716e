"""The checksums of a stack cache: one for the plane of each channel and light, and one for the saturation bits.

They are compared once in a process before a cache is read for the first time, so that a damaged or truncated cache is made again instead
of giving other values. CRC-32 finds every change of up to 32 neighbouring bits, and others but for one in 2^32; it reads 4 GB a second.
"""

import os
import threading
import zlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import numpy as np

THREADS = 4
"""The threads that compare checksums: memory and disks are not faster with more."""

PIECE_BYTES = 4 << 20
"""The bytes of a file that one thread holds at one time."""

_sound: dict[Path, tuple[int, ...]] = {}
"""The files that were compared in this process, with their state then."""
_sound_lock = threading.Lock()


def of_plane(plane: np.ndarray, padding: int) -> int:
    """Return the checksum of a plane that is followed by zeros; `padding`: the bytes of zeros behind it."""
    return zlib.crc32(bytes(padding), zlib.crc32(plane.data))


def is_sound(path: Path, shape: tuple[int, ...], kind: type[np.generic], checksums: Iterable[int]) -> bool:
    """Return whether a cache file holds an array of this shape and type whose planes have these checksums.
    `shape`: of the array; the last axis and, for half values, the light axis are padded. `checksums`: of the planes along the last axis in
    C order, or of the whole array where there is one."""
    expected = list(checksums)
    try:
        state = _state(path)
        with _sound_lock:
            if _sound.get(path) == state:
                return True
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        if values.shape != shape or values.dtype != np.dtype(kind) or not values.flags.c_contiguous or not expected:
            return False
        start, size = values.offset, values.nbytes // len(expected)
        del values
        edges = [len(expected) * part // THREADS for part in range(THREADS + 1)]
        with ThreadPoolExecutor(THREADS, thread_name_prefix="relit-checksums") as pool:
            if not all(pool.map(lambda first, end: _have(path, start + first * size, size, expected[first:end]), edges, edges[1:])):
                return False
    except (OSError, ValueError, EOFError, SyntaxError, MemoryError):  # gone, truncated, or the header is damaged
        return False
    with _sound_lock:
        _sound[path] = state
    return True


def _have(path: Path, start: int, size: int, checksums: Sequence[int]) -> bool:
    """Return whether consecutive parts of a file have these checksums. They are read: mapped pages would stay in the process."""
    with open(path, "rb", buffering=0) as file:
        file.seek(start)
        return all(_of_next(file, size) == checksum for checksum in checksums)


def _of_next(file: BinaryIO, size: int) -> int:
    checksum = 0
    while size > 0 and (content := file.read(min(size, PIECE_BYTES))):
        checksum, size = zlib.crc32(content, checksum), size - len(content)
    return checksum


def _state(path: Path) -> tuple[int, ...]:
    status = os.stat(path)
    return status.st_ino, status.st_size, status.st_mtime_ns
