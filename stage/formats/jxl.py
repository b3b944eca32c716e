"""The size of a JPEG XL image from its first bytes, because the library behind OpenImageIO decodes all pixels to report it."""

import os
import struct
from pathlib import Path
from typing import BinaryIO

from stage import inputs
from stage.errors import ImageError, storage

CODESTREAM = b"\xff\x0a"
CONTAINER = b"\x00\x00\x00\x0cJXL \r\n\x87\n"
SIZE_BYTES = 16
"""The bytes that are read, more than the signature (2 bytes) and the size header (1 + 32 + 3 + 32 bits) take."""
SIZE_BITS = (9, 13, 18, 30)
"""The bits of a dimension less one, by its selector (ISO/IEC 18181-1, table of SizeHeader)."""
RATIOS = {1: (1, 1), 2: (12, 10), 3: (4, 3), 4: (3, 2), 5: (16, 9), 6: (5, 4), 7: (2, 1)}
"""The ratios of width to height for files that do not hold the width, by their code."""


def resolution(path: str | Path) -> tuple[int, int]:
    """Return the width and height of a JPEG XL image."""
    with inputs.opened(path) as source:
        return resolution_of(path, source.file)


def resolution_of(path: str | Path, stream: BinaryIO) -> tuple[int, int]:
    """Return the width and height of a JPEG XL image that is open; errors are those of `resolution`."""
    with storage("read", path):
        stream.seek(0)
        start = stream.read(len(CONTAINER))
        if start[:2] == CODESTREAM:
            stream.seek(0)
            return _size(path, stream.read(SIZE_BYTES))
        if start != CONTAINER:
            raise ImageError(f"{path}: is not a JPEG XL file")
        end = os.fstat(stream.fileno()).st_size
        while len(header := stream.read(8)) == 8:
            length, kind = struct.unpack(">I4s", header)
            begin = stream.tell()
            if length == 1:
                begin, length = begin + 8, int.from_bytes(stream.read(8), "big") - 8
            if kind in (b"jxlc", b"jxlp"):
                stream.seek(begin + (4 if kind == b"jxlp" else 0))  # behind the number of the part
                return _size(path, stream.read(SIZE_BYTES))
            if length < 8 or begin + length - 8 > end:
                break
            stream.seek(begin + length - 8)
    raise ImageError(f"{path}: is damaged or truncated: its header cannot be read")


def _size(path: str | Path, start: bytes) -> tuple[int, int]:
    if start[:2] != CODESTREAM:
        raise ImageError(f"{path}: is damaged or truncated: its header cannot be read")
    bits, at = int.from_bytes(start[2:], "little"), 0

    def take(count: int) -> int:
        nonlocal at
        value = bits >> at & (1 << count) - 1
        at += count
        return value

    small = take(1)

    def dimension() -> int:
        return 8 * (1 + take(5)) if small else 1 + take(SIZE_BITS[take(2)])

    height, ratio = dimension(), take(3)
    across, down = RATIOS.get(ratio, (0, 1))
    width = height * across // down if ratio else dimension()
    if at > 8 * len(start[2:]):
        raise ImageError(f"{path}: is damaged or truncated: its header cannot be read")
    return width, height
