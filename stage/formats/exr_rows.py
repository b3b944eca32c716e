"""Writing of an EXR file some rows at a time, so that a picture need not be in memory whole.

The library encodes each block of rows as a file of its own. Its compressed chunks, which do not depend on the other rows, are moved into
the file of the whole picture, whose header and table of chunk offsets are written here.

Source: "OpenEXR File Layout" of the OpenEXR documentation.
"""

import os
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stage.errors import storage
from stage.files import folder_beside, replacing
from stage.formats import exr, exr_scan
from stage.formats.exr_scan import SCANLINES_PER_CHUNK, SEVERAL_PARTS

BLOCK_ROWS = 32
"""Every block but the last has a multiple of so many rows: the chunks of all compressions that Relit writes with divide it."""
BLOCK_PIXELS = 1 << 20
"""Pixels that `write` hands over at a time: a second of work for the channels of maps."""


class _Attribute(NamedTuple):
    """The place of an attribute's value in a header."""

    part: int
    name: bytes
    begin: int
    end: int


class RowFile:
    """An EXR file that takes rows from the top to the bottom."""

    def __init__(self, temporary: Path, *, path: Path, rows: int, metadata: Mapping[str, Any]) -> None:
        """Begin a file."""
        self._temporary, self._path, self._rows, self._metadata = temporary, path, rows, metadata
        self._taken = 0
        self._table = 0
        self._offsets: list[np.ndarray] = []  # of each part, [chunks] uint64

    def append(self, parts: Sequence[exr.Part]) -> None:
        """Write the next rows.
        `parts`: those of the picture, with the same channels in every call, each [rows, cols]; rows must be a multiple of BLOCK_ROWS unless
        they are the last."""
        rows = len(next(iter(parts[0].channels.values())))
        if self._taken + rows > self._rows or (rows % BLOCK_ROWS and self._taken + rows < self._rows):
            raise ValueError(f"{rows} rows after {self._taken} of {self._rows}: give multiples of {BLOCK_ROWS} until the last")
        with folder_beside(self._path) as folder:
            block = folder / "rows.exr"
            exr.encode(block, parts, metadata=self._metadata, path=self._path)
            content = block.read_bytes()
        several = bool(content[5] & SEVERAL_PARTS)
        attributes = list(_attributes(content, several=several))
        of_chunk = [SCANLINES_PER_CHUNK[content[each.begin]] for each in attributes if each.name == b"compression"]
        behind = attributes[-1].end + (2 if several else 1)  # the zeros that end the header, and the list of headers
        if not self._offsets:
            self._offsets = [np.zeros(-(-self._rows // count), np.uint64) for count in of_chunk]
            self._table = behind
        moved = bytearray()
        with storage("write", self._path), open(self._temporary, "r+b") as file:
            if self._taken == 0:
                file.write(_of_whole(content[:behind], attributes, self._rows, of_chunk))
                file.write(bytes(8 * sum(map(len, self._offsets))))
            at = file.seek(0, os.SEEK_END)
            table = behind
            for part, count in enumerate(of_chunk):
                chunks = -(-rows // count)
                for number, begin in enumerate(struct.unpack_from(f"<{chunks}Q", content, table)):
                    place = begin + (4 if several else 0)  # the number of the part, then the first row and the bytes
                    row, size = struct.unpack_from("<ii", content, place)
                    self._offsets[part][self._taken // count + number] = at + len(moved)
                    moved += content[begin:place] + struct.pack("<i", row + self._taken) + content[place + 4 : place + 8 + size]
                table += 8 * chunks
            file.write(moved)
        self._taken += rows

    def close(self, *, checksum: bool) -> None:
        """Write what the file ends with, once it has all rows."""
        if self._taken < self._rows:
            raise ValueError(f"{self._rows - self._taken} of {self._rows} rows are missing")
        with storage("write", self._path), open(self._temporary, "r+b") as file:
            file.seek(self._table)
            file.write(b"".join(each.astype("<u8").tobytes() for each in self._offsets))
        exr.finish(self._temporary, path=self._path, checksum=checksum)


@contextmanager
def growing(path: Path, *, rows: int, metadata: Mapping[str, Any], checksum: bool = False) -> Iterator[RowFile]:
    """Yield a file that takes the rows of a picture; it exists when the block ends without an error, whole, and else not at all."""
    if checksum:
        metadata = {**metadata, exr_scan.CHECKSUM_ATTRIBUTE: exr_scan.UNSET_CHECKSUM}
    with replacing(path) as temporary:
        file = RowFile(temporary, path=path, rows=rows, metadata=metadata)
        yield file
        file.close(checksum=checksum)


def write(path: str | Path, channels: Mapping[str, np.ndarray], *, color_space: str, metadata: Mapping[str, Any],
          progress: Callable[[int], None]) -> None:
    """Write what exr.write does, some rows at a time; `progress`: told how many are written."""
    rows, cols = next(iter(channels.values())).shape
    step = max(1, BLOCK_PIXELS // (BLOCK_ROWS * cols)) * BLOCK_ROWS
    with growing(Path(path), rows=rows, metadata=metadata) as file:
        for first in range(0, rows, step):
            block = {name: plane[first : first + step] for name, plane in channels.items()}
            file.append([exr.Part("", block, color_space, exr.Compression.ZIP)])
            progress(min(first + step, rows))


def _attributes(header: bytes, *, several: bool) -> Iterator[_Attribute]:
    at, part = 8, 0
    while header[at]:
        while header[at]:
            kind = header.index(0, at) + 1
            begin = header.index(0, kind) + 5
            end = begin + struct.unpack_from("<i", header, begin - 4)[0]
            yield _Attribute(part, header[at : kind - 1], begin, end)
            at = end
        if not several:
            return
        at, part = at + 1, part + 1


def _of_whole(header: bytes, attributes: Sequence[_Attribute], rows: int, of_chunk: Sequence[int]) -> bytes:
    """Return the header of the whole picture from that of its first rows."""
    changed = bytearray(header)
    for each in attributes:
        if each.name in (b"dataWindow", b"displayWindow"):
            struct.pack_into("<i", changed, each.end - 4, rows - 1)
        elif each.name == b"chunkCount":
            struct.pack_into("<i", changed, each.begin, -(-rows // of_chunk[each.part]))
    return bytes(changed)
