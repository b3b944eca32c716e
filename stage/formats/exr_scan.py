"""A bounded look through the header of an OpenEXR file, before the library reads all of it: 100 000 channels would take it 20 seconds.

Source: "OpenEXR File Layout" of the OpenEXR documentation.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from stage.errors import ImageError

MAX_HEADER_BYTES = 4 << 20
"""The most bytes of the headers of all parts: a preview picture of 512×512 has a quarter of it."""
MAX_ATTRIBUTES, MAX_PARTS, MAX_CHANNELS = 4000, 256, 1024
"""The most attributes, parts and channels of a file. Renderers write up to some hundred channels."""
MAX_NAME = 255
"""The most bytes of a name, as of the format."""
SEVERAL_PARTS = 0x10
"""The bit of the second byte of the version that says that the file has several parts."""
CHANNEL_BYTES = 16
"""The bytes of a channel behind its name: type, linearity and two sampling rates."""
HALF = struct.pack("<i", 1)
"""The type of a channel of half values."""


class Scan(NamedTuple):
    """What was found in the headers of all parts."""

    table: int
    """The position of the first byte behind them: of the tables of chunk offsets."""
    half: frozenset[str]
    """The names of the channels with half values."""


def scan_header(path: Path, stream: BinaryIO) -> Scan:
    """Check how much the header of an EXR file holds.

    Raises:
        ImageError: the header has too many attributes, parts or channels, is too long, or is cut short.
    """
    stream.seek(0)
    head = stream.read(min(os.fstat(stream.fileno()).st_size, MAX_HEADER_BYTES))
    several = len(head) > 8 and bool(head[5] & SEVERAL_PARTS)
    at, attributes, channels = 8, 0, 0
    half: set[str] = set()
    for part in range(MAX_PARTS + 1):
        if part == MAX_PARTS:
            raise ImageError(f"{path}: has more than {MAX_PARTS} parts")
        while (name := _name(path, head, at)) > at + 1:
            kind = _name(path, head, name)
            if kind + 4 > len(head):
                raise _broken(path, head)
            size = struct.unpack_from("<i", head, kind)[0]
            begin, end = kind + 4, kind + 4 + size
            if size < 0 or end > len(head):
                raise _broken(path, head)
            if head[name : kind - 1] == b"chlist":
                for channel in _channels(path, head, begin, end, MAX_CHANNELS - channels):
                    channels += 1
                    kind = _name(path, head, channel)
                    if head[kind : kind + len(HALF)] == HALF:
                        half.add(head[channel : kind - 1].decode(errors="replace"))
            attributes += 1
            if attributes > MAX_ATTRIBUTES:
                raise ImageError(f"{path}: has more than {MAX_ATTRIBUTES} attributes in its header")
            at = end
        at = name
        if not several:
            break
        if head[at : at + 1] == b"\0":  # an empty header ends the list of headers
            return Scan(at + 1, frozenset(half))
    return Scan(at, frozenset(half))


def _channels(path: Path, head: bytes, at: int, end: int, most: int) -> Iterator[int]:
    """Yield the positions of the channels of a list.

    Raises:
        ImageError: there are more than `most`.
    """
    count = 0
    while at < end and head[at]:
        count += 1
        if count > most:
            raise ImageError(f"{path}: has more than {MAX_CHANNELS} channels")
        yield at
        at = _name(path, head, at) + CHANNEL_BYTES


def _name(path: Path, head: bytes, at: int) -> int:
    """Return the position behind a name and its final zero."""
    end = head.find(b"\0", at, at + MAX_NAME + 1)
    if end < 0:
        raise _broken(path, head)
    return end + 1


def _broken(path: Path, head: bytes) -> ImageError:
    if len(head) == MAX_HEADER_BYTES:
        return ImageError(f"{path}: has a header that is damaged, or longer than {MAX_HEADER_BYTES >> 20} MiB")
    return ImageError(f"{path}: is damaged or truncated: its header cannot be read")
