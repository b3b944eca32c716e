"""Checks of image files before a library decodes them: PNG and JPEG files are whole, and how large a JPEG XL image is.

libpng reports damage on the terminal, and libjpeg fills missing data with grey and reports success. The library behind OpenImageIO decodes
all pixels of a JPEG XL file to report its size.
"""

import os
import re
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from stage import inputs
from stage.errors import ImageError, storage

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_MARKER = re.compile(rb"\xff\xff*([^\x00\xd0-\xd7\xff])")
"""A marker that ends entropy-coded data: neither a stuffed byte (00) nor a restart marker (D0 to D7), after any fill bytes. It
begins with a single byte, which `re` finds ten times as fast as `\\xff+`."""
JPEG_START, JPEG_END, JPEG_SCAN = b"\xd8", b"\xd9", b"\xda"
CODESTREAM = b"\xff\x0a"
CONTAINER = b"\x00\x00\x00\x0cJXL \r\n\x87\n"
SIZE_BYTES = 16
"""The bytes that are read, more than the signature (2 bytes) and the size header (1 + 32 + 3 + 32 bits) take."""
SIZE_BITS = (9, 13, 18, 30)
"""The bits of a dimension less one, by its selector (ISO/IEC 18181-1, table of SizeHeader)."""
RATIOS = {1: (1, 1), 2: (12, 10), 3: (4, 3), 4: (3, 2), 5: (16, 9), 6: (5, 4), 7: (2, 1)}
"""The ratios of width to height for files that do not hold the width, by their code."""


def check_png(path: str | Path, stream: BinaryIO, *, contents: bool) -> None:
    """Check that the chunks of a PNG file follow each other up to the end chunk.
    `contents`: True compares the checksum of every chunk; False reads the lengths and types of the chunks only.

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


def jxl_resolution(path: str | Path) -> tuple[int, int]:
    """Return the width and height of a JPEG XL image."""
    with inputs.opened(path) as source:
        return jxl_resolution_of(path, source.file)


def jxl_resolution_of(path: str | Path, stream: BinaryIO) -> tuple[int, int]:
    """Return the width and height of a JPEG XL image that is open; errors are those of `jxl_resolution`."""
    with storage("read", path):
        stream.seek(0)
        start = stream.read(len(CONTAINER))
        if start[:2] == CODESTREAM:
            stream.seek(0)
            return _jxl_size(path, stream.read(SIZE_BYTES))
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
                return _jxl_size(path, stream.read(SIZE_BYTES))
            if length < 8 or begin + length - 8 > end:
                break
            stream.seek(begin + length - 8)
    raise ImageError(f"{path}: is damaged or truncated: its header cannot be read")


def _jxl_size(path: str | Path, start: bytes) -> tuple[int, int]:
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
