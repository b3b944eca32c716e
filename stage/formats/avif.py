"""AVIF images: size and depth from the boxes of the file, before a pixel is decoded, and the pixels through OpenCV.

Source: Alliance for Open Media, "AV1 Image File Format (AVIF)"; boxes of ISO/IEC 14496-12 and 23008-12 (HEIF): pitm names the image,
ipma lists its properties in ipco, of which ispe is the size, av1C the coding and irot, imir and clap what is done to the image afterwards.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from stage.errors import ImageError, storage

MOST_META_BYTES = 1 << 20
"""The largest box of metadata that is read; that of an image of one tile has some hundred bytes."""
TURNS = (b"irot", b"imir", b"clap")
"""Properties after which the image is another than the decoded one."""


class AvifHeader(NamedTuple):
    """Size and format of an image, read before it is decoded."""

    width: int
    height: int
    channels: int  # 1 for monochrome, else 3
    bits: int  # of a value: 8, 10 or 12


def header_of(path: str | Path, stream: BinaryIO) -> AvifHeader:
    """Read the size and the depth of an AVIF image that is open.
    Raises ImageError if the file is no AVIF image, truncated, damaged, an image sequence, or one that is turned, mirrored or cropped after
    decoding."""
    with storage("read", path):
        meta, is_whole = _meta(stream)
    if meta is None:
        raise ImageError(f"{path}: is not an AVIF image")
    if not is_whole:
        raise ImageError(f"{path}: is truncated: its last box is longer than the file")
    try:
        properties = dict(_primary_properties(meta))
        width, height = struct.unpack_from(">II", properties[b"ispe"], 4)
        coding = properties[b"av1C"][2]
    except (struct.error, KeyError, IndexError) as error:
        raise ImageError(f"{path}: is damaged: its header does not say how large the image is") from error
    turned = next((kind.decode() for kind in TURNS if kind in properties), None)
    if turned is not None:
        raise ImageError(f"{path}: is to be turned, mirrored or cropped after decoding ({turned}): write it as it is to be seen")
    if min(width, height) < 1:
        raise ImageError(f"{path}: is damaged: it has {width}x{height} pixels")
    return AvifHeader(width, height, 1 if coding & 0x10 else 3, 8 if not coding & 0x40 else 12 if coding & 0x20 else 10)


def decode(path: str | Path, stream: BinaryIO, header: AvifHeader) -> np.ndarray:
    """Decode an AVIF image that is open, without alpha: [rows, cols, 1 or 3] uint8, or float32 fractions of full scale of deeper images."""
    import cv2  # a tenth of a second that captures of other images need not wait

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # OpenCV writes on the terminal what it raises too
    with storage("read", path):
        stream.seek(0)
        data = np.frombuffer(stream.read(), np.uint8)
    try:
        decoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        decoded = None
    if decoded is None or decoded.shape[:2] != (header.height, header.width):
        raise ImageError(f"{path}: cannot be decoded: its data is damaged")
    pixels = decoded[..., None] if decoded.ndim == 2 else decoded[..., 2::-1]
    if header.bits == 8:
        return np.ascontiguousarray(pixels)
    return pixels.astype(np.float32) / np.float32((1 << header.bits) - 1)


def _meta(stream: BinaryIO) -> tuple[bytes | None, bool]:
    """Return the content of the box of metadata, or None where the file is no AVIF image; and whether all boxes are whole."""
    stream.seek(0, os.SEEK_END)
    end = stream.tell()
    at, is_avif, meta = 0, False, None
    while at + 8 <= end:
        stream.seek(at)
        size, kind = struct.unpack(">I4s", stream.read(8))
        if size == 1:  # the length follows in 64 bits
            size = int.from_bytes(stream.read(8), "big")
        elif size == 0:  # up to the end of the file
            size = end - at
        if size < 8:
            return None, False
        if kind == b"ftyp":
            is_avif = b"avif" in stream.read(min(size - 8, 256))
        elif kind == b"meta" and is_avif and size <= min(MOST_META_BYTES, end - at):
            meta = stream.read(size - 8)[4:]
        at += size
    return meta, at == end


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if size < 8 or at + size > len(data):
            raise IndexError
        yield kind, data[at + 8 : at + size]
        at += size


def _primary_properties(meta: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield the properties of the image of a file by their kinds."""
    found = dict(_boxes(meta))
    primary, = struct.unpack_from(">H" if found[b"pitm"][0] == 0 else ">I", found[b"pitm"], 4)
    inner = dict(_boxes(found[b"iprp"]))
    properties, links = list(_boxes(inner[b"ipco"])), inner[b"ipma"]
    (count,), at = struct.unpack_from(">I", links, 4), 8
    item, wide = (">I" if links[0] else ">H"), links[3] & 1
    for _ in range(count):
        (number,), at = struct.unpack_from(item, links, at), at + struct.calcsize(item)
        linked, at = links[at], at + 1
        for _ in range(linked):
            index = (struct.unpack_from(">H", links, at)[0] & 0x7FFF) if wide else links[at] & 0x7F
            at += 2 if wide else 1
            if number == primary and index:
                yield properties[index - 1]
