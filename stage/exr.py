"""OpenEXR files: named channels in and out, with metadata; written whole or not at all."""

import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from stage.errors import ImageError, StorageError, storage
from stage.files import replacing

SCANLINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""Compression code of the file format → rows per chunk (OpenEXR file layout, "Scan line blocks")."""


class Compression:
    """Names for the compressions that relit writes."""

    ZIP = OpenEXR.ZIP_COMPRESSION
    PIZ = OpenEXR.PIZ_COMPRESSION
    DWAA = OpenEXR.DWAA_COMPRESSION


DWA_LEVEL = 45.0
"""How lossy DWAA is: the library's own default, written into the file so that it is known; 0 loses least."""


class Header(NamedTuple):
    """What an EXR says about itself before any pixel is read."""

    width: int
    height: int
    channels: tuple[str, ...]
    metadata: dict[str, Any]


def read_header(path: str | Path) -> Header:
    """Read the header only.

    Raises:
        ImageError: not an EXR, truncated, of several parts, or deep.
        StorageError: the file cannot be opened.
    """
    with storage("read", path), open(path, "rb") as stream:
        start = stream.read(8)
    if start[:4] != b"\x76\x2f\x31\x01":
        raise ImageError(f"{path}: is not an OpenEXR file")
    if len(start) < 8:
        raise ImageError(f"{path}: is damaged or truncated: its header cannot be read")
    if start[5] & 0x18:  # version bits 11 and 12: deep data, several parts
        raise ImageError(f"{path}: has several parts or deep data: give a single-part flat image")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            attributes = dict(file.header())
        (left, top), (right, bottom) = attributes["dataWindow"]
        names = tuple(channel.name for channel in attributes["channels"])
        header = Header(int(right - left + 1), int(bottom - top + 1), names, attributes)
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise ImageError(f"{path}: is damaged or truncated: its header cannot be read") from error
    missing = _missing_bytes(path, header)
    if missing:
        raise ImageError(f"{path}: is truncated: {missing} or more bytes are missing")
    return header


def read(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read every channel.

    Returns:
        channels: name → [rows, cols] in the type it is stored as; metadata: attribute → value.

    Raises:
        ImageError: not a readable flat single-part EXR.
        StorageError: the file cannot be opened.
    """
    header = read_header(path)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise ImageError(f"{path}: cannot be decoded: its data is damaged") from error
    return channels, header.metadata


def write(path: str | Path, channels: Mapping[str, np.ndarray], *, color_space: str, metadata: Mapping[str, str],
          compression: Any = Compression.ZIP) -> None:
    """Write one single-part EXR.

    Args:
        channels: name → [rows, cols] float16 or float32.
        color_space: a scene-linear colour space by its interchange name; kept as `colorInteropID`, with the
            `chromaticities` that readers without that attribute understand.
        metadata: further string attributes.
        compression: one of Compression. DWAA is lossy in the channels whose name ends in R, G, B or Y, of every layer.

    Raises:
        StorageError: the file cannot be written; nothing is left behind.
    """
    header: dict[str, Any] = {"compression": compression, "type": OpenEXR.scanlineimage, "colorInteropID": color_space,
                              **metadata}
    if compression == Compression.DWAA:
        header["dwaCompressionLevel"] = DWA_LEVEL
    chromaticities = OpenEXR.colorInteropIDToChromaticities(color_space)
    if chromaticities is not None:
        header["chromaticities"] = chromaticities
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with replacing(path) as temporary:
        try:
            OpenEXR.File(header, planes).write(str(temporary))
        except RuntimeError as error:
            raise StorageError(f"cannot write {path}: {_one_line(error)}") from error
        try:
            read_header(temporary)
        except ImageError as error:
            raise StorageError(f"cannot write {path}: the disk took only part of it") from error


PRIMARIES = ("lin_rec709_scene", "lin_ap1_scene", "lin_ap0_scene", "lin_rec2020_scene", "lin_p3d65_scene")
"""Scene-linear spaces that `chromaticities` are compared with."""
PRIMARIES_TOLERANCE = 2e-3
"""Of a coordinate: writers round them."""


def color_space_of(metadata: Mapping[str, Any], default: str = "lin_rec709_scene") -> str:
    """The scene-linear colour space that a header names by `colorInteropID`, or shows by `chromaticities`; else `default`.

    Raises:
        ValueError: chromaticities of no known space.
    """
    if (name := metadata.get("colorInteropID")) is not None:
        return str(name)
    if (given := metadata.get("chromaticities")) is None:
        return default
    for space in PRIMARIES:
        if np.allclose(given, OpenEXR.colorInteropIDToChromaticities(space), atol=PRIMARIES_TOLERANCE):
            return space
    raise ValueError("has chromaticities of no known colour space: convert it to Rec.709, Rec.2020, P3-D65, ACEScg or ACES2065-1")


def _missing_bytes(path: str | Path, header: Header) -> int:
    """How many bytes a file lacks at the least, judged by its last chunk; 0 when whole (or of several levels: not judged).

    The library reports a short file only while it decodes, and then on the terminal too.
    """
    chunks, leader = _layout(header)
    if chunks == 0:
        return 0
    size = os.path.getsize(path)
    with open(path, "rb") as stream:
        stream.seek(8)  # magic number and version
        while _skip_attribute(stream):
            pass
        if stream.tell() + 8 * chunks > size:  # before so much memory is asked for: the header can claim any number
            return stream.tell() + 8 * chunks - size
        offsets = struct.unpack(f"<{chunks}Q", stream.read(8 * chunks))
        last = max(offsets)
        if min(offsets) < stream.tell() or last >= size:
            return max(1, last - size)  # the table is written last: zeros where the writer stopped early
        stream.seek(last + leader)
        block = stream.read(4)
        packed = struct.unpack("<i", block)[0] if len(block) == 4 else 0
        return max(0, last + leader + 4 + packed - size)


def _layout(header: Header) -> tuple[int, int]:
    """Chunks of the file, and the bytes in front of a chunk's size: the row, or the tile's place and level. (0, 0): not known."""
    if header.metadata["type"] == OpenEXR.scanlineimage:
        return -(-header.height // SCANLINES_PER_CHUNK.get(int(header.metadata["compression"]), 1)), 4
    tiles = header.metadata["tiles"]
    if tiles.mode != OpenEXR.LevelMode.ONE_LEVEL:
        return 0, 0
    return -(-header.width // tiles.xSize) * -(-header.height // tiles.ySize), 16


def _skip_attribute(stream: Any) -> bool:
    """Step over one header attribute; False at the end of the header."""
    if not _text(stream):
        return False
    _text(stream)
    size = stream.read(4)
    if len(size) < 4 or size[3] & 0x80:  # negative
        return False
    stream.seek(struct.unpack("<i", size)[0], 1)
    return True


def _text(stream: Any) -> bytes:
    text = bytearray()
    while (byte := stream.read(1)) not in (b"", b"\0"):
        text += byte
    return bytes(text)


def _one_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[0].rstrip(".") if str(error).strip() else type(error).__name__
