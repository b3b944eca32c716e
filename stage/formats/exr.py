"""Reading and writing of OpenEXR files of one part or several: named channels, metadata, colour space and compression."""

import os
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from stage import inputs
from stage.errors import ImageError, StorageError, storage
from stage.files import replacing
from stage.formats import exr_scan
from stage.formats.exr_scan import missing_bytes, scan_header

HALF_MAX = 65504.0
"""The largest half value."""
HALF_NORMAL, HALF_STEP = 2.0**-14, 2.0**-24
"""The least half value that has all its digits, and the step between the values below it."""


class Compression:
    """The compressions with which relit writes."""

    ZIP = OpenEXR.ZIP_COMPRESSION
    PIZ = OpenEXR.PIZ_COMPRESSION
    DWAA = OpenEXR.DWAA_COMPRESSION


DWA_LEVEL = 45.0
"""The compression level of DWAA, for which 0 loses least: the default of the library, stated in the file."""

LARGE_VALUES = 1 << 22
"""The number of values from which an image is compressed and decoded by threads of the library, which start once in a process."""
_starting = threading.Lock()

DATA = "data"
"""The `colorInteropID` of channels that are no colours, which no reader should convert (Color Interop Forum)."""
DEEP_DATA = 0x08
"""The bit of the second byte of the version that says that the file has deep data."""


class Header(NamedTuple):
    """The header of an EXR file: the size of its display window, its channels of all parts, and the attributes of its first part."""

    width: int
    height: int
    channels: tuple[str, ...]
    metadata: dict[str, Any]
    half: frozenset[str]
    """The channels with half values."""
    stored: tuple[int, int, int, int]
    """The rows and columns of the display window, first ones and those behind the last, of which the file stores pixels: a part of the
    picture, or more than it."""


class Part(NamedTuple):
    """One part of an EXR file: channels that share a colour space and a compression."""

    name: str
    channels: Mapping[str, np.ndarray]  # each [rows, cols] float16 or float32
    color_space: str
    """The interchange name of a scene-linear colour space, or DATA. It is written as `colorInteropID`, and as `chromaticities` for readers
    that do not know that attribute."""
    compression: Any = Compression.ZIP
    """A member of Compression. DWAA is lossy in the channels whose name ends in R, G, B or Y, of every layer."""


def read_header(path: str | Path) -> Header:
    """Read the header of an EXR file, and check from its chunk tables that the file is whole.
    Raises ImageError if the file is not an EXR, is truncated, or has deep data, parts of different sizes, or one channel in several
    parts."""
    with inputs.opened(path) as source:
        return header_of(source)


def header_of(source: inputs.Source) -> Header:
    """Read the header of an EXR file that is open; errors are those of `read_header`."""
    path, stream = source.path, source.file
    with storage("read", path):
        stream.seek(0)
        start = stream.read(8)
    if start[:4] != b"\x76\x2f\x31\x01":
        raise ImageError(f"{path}: is not an OpenEXR file")
    if len(start) < 8:
        raise ImageError(f"{path}: is damaged or truncated: its header cannot be read")
    if start[5] & DEEP_DATA:
        raise ImageError(f"{path}: has deep data: give a flat image")
    found = scan_header(path, stream)
    try:
        with source.reopened() as same, OpenEXR.File(same, header_only=True) as file:
            parts = [dict(file.header(index)) for index in range(len(file.parts))]
        windows = [_window(attributes["dataWindow"]) for attributes in parts]
        top, left, bottom, right = _window(parts[0]["displayWindow"])
        names = tuple(channel.name for attributes in parts for channel in attributes["channels"])
        missing = missing_bytes(stream, found.table, parts)
    except (RuntimeError, ValueError, TypeError, KeyError, IndexError) as error:
        raise ImageError(f"{path}: is damaged or truncated: its header cannot be read") from error
    if missing:
        raise ImageError(f"{path}: is truncated: {missing} or more bytes are missing")
    if len(set(windows)) > 1:
        raise ImageError(f"{path}: has parts with different data windows: give an image whose parts have one size")
    if (twice := next((name for name, count in Counter(names).items() if count > 1), None)) is not None:
        raise ImageError(f"{path}: has several parts with a channel {twice}: give an image with one view")
    if right <= left or bottom <= top:
        raise ImageError(f"{path}: has an empty display window")
    first, cut, last, end = windows[0]
    return Header(right - left, bottom - top, names, parts[0], found.half, (first - top, cut - left, last - top, end - left))


def read(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read every channel of every part of an EXR file.
    Returns the channels by name, each [rows, cols] of the display window in its stored type, 0 where the file stores no pixels, and the
    attributes of the first part's header by name."""
    with inputs.opened(path) as source:
        header = header_of(source)
        if header.width * header.height * len(header.channels) >= LARGE_VALUES:
            _start_threads()
        return read_open(source)


def read_open(source: inputs.Source) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read an EXR file that is open, as `read` does."""
    path, header = source.path, header_of(source)
    top, left, bottom, right = header.stored
    for width, height in ((header.width, header.height), (right - left, bottom - top)):
        source.check_pixels(width, height)
    try:
        with source.reopened() as same, OpenEXR.File(same, separate_channels=True) as file:
            channels = {name: _displayed(channel.pixels, header)
                        for index in range(len(file.parts)) for name, channel in file.channels(index).items()}
    except (RuntimeError, ValueError) as error:
        raise ImageError(f"{path}: cannot be decoded: its data is damaged") from error
    if len(channels) < len(header.channels):  # the library leaves out a part that it cannot decode
        raise ImageError(f"{path}: cannot be decoded: its data is damaged")
    return channels, header.metadata


def _window(corners: Sequence[Sequence[int]]) -> tuple[int, int, int, int]:
    """Return the first row and column of a window, and those behind the last."""
    (left, top), (right, bottom) = corners
    return int(top), int(left), int(bottom) + 1, int(right) + 1


def _displayed(pixels: np.ndarray, header: Header) -> np.ndarray:
    """Return stored pixels in their place of the display window, and 0 around them."""
    top, left, bottom, right = header.stored
    if header.stored == (0, 0, header.height, header.width) or pixels.shape != (bottom - top, right - left):  # or a channel of fewer pixels
        return pixels
    shown = np.zeros((header.height, header.width), dtype=pixels.dtype)
    rows, cols = slice(max(top, 0), max(bottom, 0)), slice(max(left, 0), max(right, 0))
    part = pixels[max(-top, 0) :, max(-left, 0) :][: max(header.height - rows.start, 0), : max(header.width - cols.start, 0)]
    shown[rows, cols] = part
    return shown


def write(path: str | Path, channels: Mapping[str, np.ndarray], *, color_space: str, metadata: Mapping[str, Any],
          compression: Any = Compression.ZIP) -> None:
    """Write an EXR file of one part whole or not at all; `channels`: the channels by name, each [rows, cols] float16 or float32."""
    write_parts(path, [Part("", channels, color_space, compression)], metadata=metadata)


def write_parts(path: str | Path, parts: Sequence[Part], *, metadata: Mapping[str, Any], checksum: bool = False) -> None:
    """Write an EXR file whole or not at all: of several parts, or, where there is one part, a file without parts.
    `parts`: with names that differ, and channels that differ and have one size. `metadata`: further attributes of the first part;
    `pixelAspectRatio` and `framesPerSecond` are written to every part. `checksum`: True to write a checksum of the file too, by which
    `stage.formats.exr_scan` finds every change of it."""
    if checksum:
        metadata = {**metadata, exr_scan.CHECKSUM_ATTRIBUTE: exr_scan.UNSET_CHECKSUM}
    with replacing(path) as temporary:
        encode(temporary, parts, metadata=metadata, path=path)
        finish(temporary, path=path, checksum=checksum)


def encode(temporary: Path, parts: Sequence[Part], *, metadata: Mapping[str, Any], path: str | Path) -> None:
    """Encode an EXR file into a temporary file."""
    written: list[tuple[dict[str, Any], dict[str, np.ndarray], str]] = []
    for part in parts:
        header: dict[str, Any] = {"compression": part.compression, "type": OpenEXR.scanlineimage, "colorInteropID": part.color_space}
        if part.compression == Compression.DWAA:
            header["dwaCompressionLevel"] = DWA_LEVEL
        if (declared := chromaticities(part.color_space)) is not None:
            header["chromaticities"] = declared
        header |= {name: value for name, value in metadata.items() if not written or name in SHARED}
        written.append((header, {name: np.ascontiguousarray(plane) for name, plane in part.channels.items()}, part.name))
    if sum(plane.size for _, channels, _ in written for plane in channels.values()) >= LARGE_VALUES:
        _start_threads()
    try:
        if len(written) == 1:
            OpenEXR.File(*written[0][:2]).write(str(temporary))
        else:
            OpenEXR.File([OpenEXR.Part(*part) for part in written]).write(str(temporary))
    except RuntimeError as error:
        raise StorageError(f"cannot write {path}: {_one_line(error)}") from error


def _start_threads() -> None:
    """Let the library compress and decode on all cores; the bytes that it writes are the same."""
    with _starting:
        if OpenEXR.global_thread_count() == 0:
            OpenEXR.set_global_thread_count(os.cpu_count() or 1)


def finish(temporary: Path, *, path: str | Path, checksum: bool) -> None:
    """Check that a temporary file is whole, and put its checksum into it where one is wanted."""
    try:
        read_header(temporary)
    except ImageError as error:
        raise StorageError(f"cannot write {path}: the disk took only part of it") from error
    if checksum:
        exr_scan.write_checksum(temporary)


SHARED = ("pixelAspectRatio", "framesPerSecond")
"""The attributes that describe every part: the format asks for one pixelAspectRatio in a file."""
PRIMARIES = ("lin_rec709_scene", "lin_ap1_scene", "lin_ap0_scene", "lin_rec2020_scene", "lin_p3d65_scene")
"""The scene-linear colour spaces with which `chromaticities` are compared."""
PRIMARIES_TOLERANCE = 2e-3
"""The largest difference of a chromaticity coordinate, because writers round the coordinates."""

WRITTEN_BY_OIIO = {
    "acescg": "lin_ap1_scene", "lin_ap1": "lin_ap1_scene", "aces2065-1": "lin_ap0_scene", "lin_ap0": "lin_ap0_scene",
    "lin_rec2020": "lin_rec2020_scene", "lin_p3d65": "lin_p3d65_scene", "srgb": "srgb_texture", "srgb_texture": "srgb_texture",
}
"""Values of `oiio:ColorSpace`, in small letters, by which OpenImageIO before version 3.1, and programs that rest on it, name a space."""
UNDECLARED = ("unknown", "data")
"""Values of `colorInteropID` that name no space of colours."""


def chromaticities(space: str) -> Sequence[float] | None:
    """Return x and y of red, green, blue and white of a colour space; None: the library does not know it."""
    return OpenEXR.colorInteropIDToChromaticities(space)


def color_space_of(metadata: Mapping[str, Any], default: str = "lin_rec709_scene") -> str:
    """Return the colour space that a header declares by `colorInteropID`, `chromaticities` or `oiio:ColorSpace`, else `default`.
    Raises ValueError if the chromaticities are those of no known colour space."""
    if (name := metadata.get("colorInteropID", UNDECLARED[0])) not in UNDECLARED:
        return str(name)
    if (given := metadata.get("chromaticities")) is None:
        return WRITTEN_BY_OIIO.get(str(metadata.get("oiio:ColorSpace")).lower(), default)
    for space in PRIMARIES:
        if (known := chromaticities(space)) is not None and np.allclose(given, known, atol=PRIMARIES_TOLERANCE):
            return space
    raise ValueError("has chromaticities of no known colour space: convert it to Rec.709, Rec.2020, P3-D65, ACEScg or ACES2065-1")


def _one_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[0].rstrip(".") if str(error).strip() else type(error).__name__
