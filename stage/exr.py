"""Reading and writing of OpenEXR files: named channels, metadata, colour space and compression."""

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
"""The rows of one chunk by the compression code of the file format (OpenEXR file layout, "Scan line blocks")."""


HALF_MAX = 65504.0
"""The largest half value."""


class Compression:
    """The compressions with which relit writes."""

    ZIP = OpenEXR.ZIP_COMPRESSION
    PIZ = OpenEXR.PIZ_COMPRESSION
    DWAA = OpenEXR.DWAA_COMPRESSION


DWA_LEVEL = 45.0
"""The compression level of DWAA, for which 0 loses least: the default of the library, stated in the file."""


class Header(NamedTuple):
    """The header of an EXR file: its size, its channels, and its attributes."""

    width: int
    height: int
    channels: tuple[str, ...]
    metadata: dict[str, Any]


def read_header(path: str | Path) -> Header:
    """Read the header of an EXR file, and check from its chunk table that the file is whole.

    Raises:
        ImageError: the file is not an EXR, is truncated, or has several parts or deep data.
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
    """Read every channel of an EXR file.

    Returns:
        The channels by name, each [rows, cols] in its stored type, and the attributes of the header by name.

    Raises:
        ImageError: the file is not a readable single-part EXR of flat data.
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
    """Write a single-part EXR file whole or not at all.

    Args:
        channels: the channels by name, each [rows, cols] float16 or float32.
        color_space: the interchange name of a scene-linear colour space; it is written as `colorInteropID`, and as
            `chromaticities` for readers that do not know that attribute.
        metadata: further string attributes.
        compression: a member of Compression. DWAA is lossy in the channels whose name ends in R, G, B or Y, of every layer.

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
"""The scene-linear colour spaces with which `chromaticities` are compared."""
PRIMARIES_TOLERANCE = 2e-3
"""The largest difference of a chromaticity coordinate, because writers round the coordinates."""


def color_space_of(metadata: Mapping[str, Any], default: str = "lin_rec709_scene") -> str:
    """Return the scene-linear colour space that a header declares by `colorInteropID` or by `chromaticities`, else `default`.

    Raises:
        ValueError: the chromaticities are those of no known colour space.
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
    """Return a lower bound of the bytes that a file lacks, from its last chunk; 0 for a whole file, or one with several levels.

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
    """Return the count of chunks and the bytes before the size in a chunk (a row, or the position and level of a tile), or (0, 0)."""
    if header.metadata["type"] == OpenEXR.scanlineimage:
        return -(-header.height // SCANLINES_PER_CHUNK.get(int(header.metadata["compression"]), 1)), 4
    tiles = header.metadata["tiles"]
    if tiles.mode != OpenEXR.LevelMode.ONE_LEVEL:
        return 0, 0
    return -(-header.width // tiles.xSize) * -(-header.height // tiles.ySize), 16


def _skip_attribute(stream: Any) -> bool:
    """Skip one header attribute and return True, or return False at the end of the header."""
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
