"""Whether an OpenEXR file is whole, as its tables of chunk offsets tell; no pixel is decoded.

Source: "OpenEXR File Layout" of the OpenEXR documentation.
"""

import os
import struct
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import OpenEXR

from stage.formats.exr_scan import SEVERAL_PARTS

SCANLINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""The rows of one chunk by the compression code of the file format ("Scan line blocks")."""
PART_NUMBER = 4
"""The bytes of the part number, with which every chunk of a file of several parts begins."""


def missing_bytes(stream: BinaryIO, table: int, parts: Sequence[Mapping[str, Any]]) -> int:
    """Return a lower bound of the bytes that a file lacks, from the last chunk of each part; 0 for a whole file, or for several levels.

    The library reports a short file only while it decodes, and then on the terminal too.

    Args:
        table: the position of the tables of chunk offsets.
        parts: the header attributes of every part, in the order of the file.

    Raises:
        OSError: the file cannot be read.
    """
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
