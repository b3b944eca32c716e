"""Checks that PNG and JPEG files are whole.

libpng reports damage on the terminal, and libjpeg fills missing data with grey and reports success.
"""

import os
import re
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from stage.errors import ImageError, storage

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_MARKER = re.compile(rb"\xff\xff*([^\x00\xd0-\xd7\xff])")
"""A marker that ends entropy-coded data: neither a stuffed byte (00) nor a restart marker (D0 to D7), after any fill bytes. It
begins with a single byte, which `re` finds ten times as fast as `\\xff+`."""
JPEG_START, JPEG_END, JPEG_SCAN = b"\xd8", b"\xd9", b"\xda"


def check_png(path: str | Path, stream: BinaryIO, *, contents: bool) -> None:
    """Check that the chunks of a PNG file follow each other up to the end chunk.

    Args:
        contents: True compares the checksum of every chunk; False reads the lengths and types of the chunks only.

    Source: W3C, "Portable Network Graphics (PNG) Specification", third edition, section 5.
    """
    with storage("read", path):
        stream.seek(0)
        if stream.read(8) != PNG_SIGNATURE:
            raise ImageError(f"{path}: is not a PNG file")
        size = os.fstat(stream.fileno()).st_size
        kind = b""
        while kind != b"IEND":
            start = stream.read(8)
            length, kind = struct.unpack(">I4s", start) if len(start) == 8 else (0, b"")
            end = stream.tell() + length + 4
            if not kind or end > size:
                raise ImageError(f"{path}: is truncated: its last chunk is missing")
            if contents:
                checksum = zlib.crc32(stream.read(length), zlib.crc32(kind))
                if stream.read(4) != struct.pack(">I", checksum):
                    raise ImageError(f"{path}: cannot be decoded: its data is damaged")
            else:
                stream.seek(end)


def check_jpeg(path: str | Path, stream: BinaryIO) -> None:
    """Check that the segments of a JPEG file follow each other up to the end marker; data after the marker is ignored.

    Source: ITU-T recommendation T.81, annex B.
    """
    with storage("read", path):
        stream.seek(0)
        data = stream.read()
    if data[:2] != b"\xff" + JPEG_START:
        raise ImageError(f"{path}: is not a JPEG file")
    found = JPEG_MARKER.match(data, 2)
    while found is not None and found[1] != JPEG_END:
        position = found.end()
        end = position + int.from_bytes(data[position : position + 2], "big")
        found = JPEG_MARKER.search(data, end) if found[1] == JPEG_SCAN else JPEG_MARKER.match(data, end)
    if found is None:
        raise ImageError(f"{path}: is truncated: its end marker is missing")
