"""Camera raw files that tests write: uncompressed DNG of a 2 × 2 mosaic.

Source: Adobe, "Digital Negative (DNG) Specification", version 1.4; the file is a TIFF 6.0.
"""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

BYTE, ASCII, SHORT, LONG, RATIONAL, SIGNED_RATIONAL = 1, 2, 3, 4, 5, 10
SIZES = {BYTE: 1, ASCII: 1, SHORT: 2, LONG: 4, RATIONAL: 8, SIGNED_RATIONAL: 8}
RGGB = (0, 1, 1, 2)
XYZ_TO_CAMERA = ((0.9, -0.3, -0.1), (-0.4, 1.2, 0.2), (-0.1, 0.2, 0.6))
"""A colour matrix such as cameras have."""


def write_dng(path: Path, mosaic: np.ndarray, *, black: Sequence[int] = (512, 520, 516, 530), white: int = 15000, orientation: int = 1,
              exposure_s: float | None = None, colors: Sequence[int] = RGGB) -> None:
    """Write a mosaic, [rows, cols] uint16, as it left the sensor.

    Args:
        path: the file.
        mosaic: counts; the colours of rows 0 and 1 and columns 0 and 1 are `colors`, and those of all others repeat them.
        black: the count of darkness at each of these four places.
        white: the count at which the sensor saturates.
        orientation: as in TIFF.
        exposure_s: the exposure time; None: the file does not say.
        colors: 0 is red, 1 green, 2 blue.
    """
    rows, cols = mosaic.shape
    data = np.ascontiguousarray(mosaic, dtype="<u2").tobytes()
    exif: list[tuple[int, int, Any]] = [] if exposure_s is None else [(33434, RATIONAL, [(round(exposure_s * 1e6), 1_000_000)])]
    exif += [(33437, RATIONAL, [(56, 10)]), (34855, SHORT, [200])]
    matrix = [(round(10_000 * value), 10_000) for row in XYZ_TO_CAMERA for value in row]
    entries = [
        (254, LONG, [0]), (256, LONG, [cols]), (257, LONG, [rows]), (258, SHORT, [16]), (259, SHORT, [1]), (262, SHORT, [32803]),
        (271, ASCII, b"Relit\0"), (272, ASCII, b"Test\0"), (273, LONG, ["data"]), (274, SHORT, [orientation]), (277, SHORT, [1]),
        (278, LONG, [rows]), (279, LONG, [len(data)]), (284, SHORT, [1]), (33421, SHORT, [2, 2]), (33422, BYTE, list(colors)),
        (34665, LONG, ["exif"]), (50706, BYTE, [1, 4, 0, 0]), (50707, BYTE, [1, 1, 0, 0]), (50708, ASCII, b"Relit Test\0"),
        (50713, SHORT, [2, 2]), (50714, SHORT, list(black)), (50717, LONG, [white]), (50721, SIGNED_RATIONAL, matrix),
        (50728, RATIONAL, [(5, 10), (10, 10), (7, 10)]), (50778, SHORT, [21]),
    ]
    start = 8
    exif_at = start + _size(entries)
    data_at = exif_at + _size(exif)
    places = {"exif": exif_at, "data": data_at}
    path.write_bytes(b"II*\0" + struct.pack("<I", start) + _folder(entries, start, places) + _folder(exif, exif_at, places) + data)


def _size(entries: list[tuple[int, int, Any]]) -> int:
    """Return the bytes of a folder of tags with the values behind it."""
    return 6 + sum(12 + (len(_bytes(kind, values, {})) + 1) // 2 * 2 * (len(_bytes(kind, values, {})) > 4) for _, kind, values in entries)


def _folder(entries: list[tuple[int, int, Any]], start: int, places: dict[str, int]) -> bytes:
    head, values = struct.pack("<H", len(entries)), b""
    behind = start + 6 + 12 * len(entries)
    for tag, kind, given in entries:
        content = _bytes(kind, given, places)
        count = len(content) // SIZES[kind]
        if len(content) <= 4:
            head += struct.pack("<HHI", tag, kind, count) + content.ljust(4, b"\0")
        else:
            head += struct.pack("<HHII", tag, kind, count, behind + len(values))
            values += content + b"\0" * (len(content) % 2)
    return head + struct.pack("<I", 0) + values


def _bytes(kind: int, given: Any, places: dict[str, int]) -> bytes:
    if kind == ASCII:
        return bytes(given)
    if kind in (RATIONAL, SIGNED_RATIONAL):
        return b"".join(struct.pack("<II" if kind == RATIONAL else "<ii", *pair) for pair in given)
    return b"".join(struct.pack({BYTE: "<B", SHORT: "<H", LONG: "<I"}[kind], places.get(value, 0) if isinstance(value, str) else value)
                    for value in given)
