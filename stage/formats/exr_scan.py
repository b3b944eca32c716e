"""Checks of an OpenEXR file without decoding: a bounded look through its header, whether its chunks are all there, and a checksum.

The library would read 100 000 channels in a header for 20 seconds, and reports a short file only while it decodes. The chunk tables of an
EXR tell a truncated file, and the decoder some of the flipped bytes; the checksum in the header, of all bytes of the file, tells any other
damage. It is computed with its own digits as zeros, so that it can lie in the file.

Source: "OpenEXR File Layout" of the OpenEXR documentation.
"""

import hashlib
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import OpenEXR

from stage import inputs
from stage.errors import ImageError, StorageError, storage

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
SCANLINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""The rows of one chunk by the compression code of the file format ("Scan line blocks")."""
PART_NUMBER = 4
"""The bytes of the part number, with which every chunk of a file of several parts begins."""
CHECKSUM_ATTRIBUTE = "relit:checksum"
"""The attribute of the first part that holds the checksum: BLAKE2b with 16 bytes, in hexadecimal digits."""
DIGITS = 32
UNSET_CHECKSUM = "0" * DIGITS
"""The value of the attribute while the file is written, and for which the checksum is computed."""
HEADER_BYTES = 4 << 20
"""The bytes from the start of a file in which the attribute is looked for: the headers of a frame take a few kilobytes."""
BLOCK = 1 << 20
"""The bytes of a file that are read at one time."""
_LEAD = CHECKSUM_ATTRIBUTE.encode() + b"\0string\0" + struct.pack("<i", DIGITS)
"""The bytes before the digits: name, type and length of the attribute."""


class Scan(NamedTuple):
    """Result of reading the headers of all parts."""

    table: int
    """The position of the first byte behind them: of the tables of chunk offsets."""
    half: frozenset[str]
    """The names of the channels with half values."""


def scan_header(path: Path, stream: BinaryIO) -> Scan:
    """Check how much the header of an EXR file holds.
    Raises ImageError if the header has too many attributes, parts or channels, is too long, or is cut short."""
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


def missing_bytes(stream: BinaryIO, table: int, parts: Sequence[Mapping[str, Any]]) -> int:
    """Return a lower bound of the bytes that a file lacks, from the last chunk of each part; 0 for a whole file, or for several levels.
    `table`: the position of the tables of chunk offsets."""
    layouts = [_layout(attributes) for attributes in parts]
    if any(chunks == 0 for chunks, _ in layouts):
        return 0
    size = os.fstat(stream.fileno()).st_size
    stream.seek(0)
    several = bool(stream.read(8)[5] & SEVERAL_PARTS)
    stream.seek(table)
    wanted = 8 * sum(chunks for chunks, _ in layouts)
    if table + wanted > size:  # before so much memory is asked for: the header can claim any number
        return table + wanted - size
    found = struct.unpack(f"<{wanted // 8}Q", stream.read(wanted))
    missing = 0
    for chunks, leader in layouts:
        offsets, found = found[:chunks], found[chunks:]
        last = max(offsets)
        if min(offsets) < table + wanted or last >= size:
            return max(1, last - size)  # the table is written last: zeros where the writer stopped early
        leader += PART_NUMBER if several else 0
        stream.seek(last + leader)
        block = stream.read(4)
        packed = struct.unpack("<i", block)[0] if len(block) == 4 else 0
        missing = max(missing, last + leader + 4 + packed - size)
    return missing


def _layout(attributes: Mapping[str, Any]) -> tuple[int, int]:
    """Return the count of chunks and the bytes before the size in a chunk (a row, or the position and level of a tile), or (0, 0)."""
    (left, top), (right, bottom) = attributes["dataWindow"]
    width, height = int(right - left + 1), int(bottom - top + 1)
    if attributes["type"] == OpenEXR.scanlineimage:
        return -(-height // SCANLINES_PER_CHUNK.get(int(attributes["compression"]), 1)), 4
    tiles = attributes["tiles"]
    if tiles.mode != OpenEXR.LevelMode.ONE_LEVEL:
        return 0, 0
    return -(-width // tiles.xSize) * -(-height // tiles.ySize), 16


def write_checksum(path: Path) -> None:
    """Put the checksum of a file into its attribute, which was written as UNSET_CHECKSUM."""
    place, checksum = _place_and_checksum(path)
    if place is None:
        raise StorageError(f"cannot write {path}: its header has no {CHECKSUM_ATTRIBUTE}")
    with storage("write", path), open(path, "r+b") as file:
        file.seek(place)
        file.write(checksum.encode())


def is_intact(path: Path) -> bool:
    """Return whether every byte of a file is as it was written; False where the file has no checksum."""
    place, checksum = _place_and_checksum(path)
    if place is None:
        return False
    with inputs.opened(path) as source, storage("read", path):
        source.file.seek(place)
        return bool(source.file.read(DIGITS) == checksum.encode())


def _place_and_checksum(path: Path) -> tuple[int | None, str]:
    """Return where the digits of the checksum begin, None if there are none, and the checksum that the file should have."""
    content = hashlib.blake2b(digest_size=DIGITS // 2)
    with inputs.opened(path) as source, storage("read", path):
        start = source.file.read(HEADER_BYTES)
        found = start.find(_LEAD)
        place = found + len(_LEAD)
        if found < 0 or place + DIGITS > len(start):
            return None, ""
        content.update(start[:place] + UNSET_CHECKSUM.encode() + start[place + DIGITS :])
        while block := source.file.read(BLOCK):
            content.update(block)
    return place, content.hexdigest()
