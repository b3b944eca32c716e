"""Headers of .npy files, which are checked before what they claim is asked of the memory, and arrays as the bytes of an .npz file."""

import io
import math
import os
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any, BinaryIO

import numpy as np

from stage.errors import ImageError, storage


def array_shape(path: str | Path, stream: BinaryIO, max_pixels: int | None = None) -> tuple[int, ...]:
    """Return the shape of a .npy file of real numbers, and leave the stream at its beginning.
    `max_pixels`: the most rows × columns, its first two sides; None for any. Raises ImageError if the file is no .npy file, not of real
    numbers, has too many pixels, or does not hold as many bytes as its header says."""
    with storage("read", path):
        try:
            version = np.lib.format.read_magic(stream)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(stream)
        except (ValueError, EOFError, SyntaxError, TypeError, TokenError, RecursionError, MemoryError) as error:  # it is read as Python
            raise ImageError(f"{path}: is not a .npy array") from error
        present = os.fstat(stream.fileno()).st_size - stream.tell()
        stream.seek(0)
    if dtype.kind not in "iuf":
        raise ImageError(f"{path}: is not an array of real numbers")
    if min(shape, default=1) < 1:
        raise ImageError(f"{path}: has the shape {shape}: give one without empty sides")
    if max_pixels is not None and math.prod(shape[:2]) > max_pixels:
        raise ImageError(f"{path}: has {'x'.join(map(str, shape[1::-1]))} pixels, {max_pixels} are allowed")
    if math.prod(shape) * dtype.itemsize != present:
        raise ImageError(f"{path}: is not a whole .npy array: it has {present} bytes of {math.prod(shape) * dtype.itemsize}")
    return shape


def packed(arrays: Mapping[str, Any]) -> bytes:
    """Return arrays and numbers by their names as bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def unpacked(content: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of `packed`."""
    with np.load(io.BytesIO(content), allow_pickle=False) as found:
        return {name: found[name] for name in found.files}
