"""Reading of MATLAB's .mat files of version 5 (`save -v6` and `-v7`, and SciPy's `savemat`): numbers, texts, cells and structures.

SciPy's `loadmat` ends the process with a segmentation fault on some files with one wrong byte, and these files come from strangers.

Source: MathWorks, "MAT-File Format", level 5. Numbers are real and not sparse; a file of version 7.3 is HDF5 and is refused with the
way out.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stage import inputs
from stage.errors import ManifestError

HEADER_BYTES = 128
MOST_BYTES = 1 << 31
"""The most bytes of a compressed variable, so that a small file cannot fill the memory."""
MATRIX, COMPRESSED = 14, 15
"""Types of data elements that hold others."""
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Type of a data element → NumPy type of its numbers."""
TEXTS = {1: "utf-8", 2: "utf-8", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
"""Type of a data element → how its characters are encoded."""
CELL, STRUCT, CHARACTERS, FIRST_NUMBER, LAST_NUMBER = 1, 2, 4, 6, 15
"""Classes of arrays; those from FIRST_NUMBER to LAST_NUMBER hold numbers."""
COMPLEX = 0x0800

Value = np.ndarray | tuple[str, ...]
"""A numeric array with MATLAB's dimensions, or the rows of a character array or the texts of a cell."""


def read_mat(path: Path) -> dict[str, Value]:
    """Read the variables of a .mat file.
    Returns the variables by name; the fields of a structure as `name.field`. Variables of other kinds (complex and sparse numbers,
    functions, cells that do not hold texts alone) are left out. Raises ManifestError if the file is not a whole .mat file of version 5; the
    message says what it is."""
    data = inputs.read_bytes(path)
    if data.startswith(b"MATLAB 7.3") or data.startswith(b"\x89HDF"):
        raise ManifestError(f"{path}: is a .mat file of version 7.3: save it in MATLAB with save -v7")
    mark = data[126:128]
    if len(data) < HEADER_BYTES or mark not in (b"IM", b"MI"):
        raise ManifestError(f"{path}: is not a .mat file of version 5: save it with save -v7, or in Octave with save -7")
    order = "<" if mark == b"IM" else ">"
    found: dict[str, Value] = {}
    try:
        for kind, content in _elements(data[HEADER_BYTES:], order):
            if kind == COMPRESSED:
                unpacked = zlib.decompressobj()
                content = unpacked.decompress(content, MOST_BYTES)
                if not unpacked.eof:
                    raise ValueError("its data is cut short, or too long")
                kind, content = next(_elements(content, order))
            if kind == MATRIX:
                name, value = _matrix(content, order)
                _keep(found, name, value)
    except (ValueError, struct.error, zlib.error, StopIteration, LookupError, RecursionError, MemoryError) as error:
        raise ManifestError(f"{path}: is a damaged .mat file") from error
    return found


def read_mat_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the numeric variables of a .mat file, as `read_mat` does."""
    return {name: value for name, value in read_mat(path).items() if isinstance(value, np.ndarray)}


def _keep(found: dict[str, Value], name: str, value: object) -> None:
    if isinstance(value, dict):
        for field, inner in value.items():
            _keep(found, f"{name}.{field}", inner)
    elif isinstance(value, np.ndarray | tuple):
        found[name] = value


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield the type and the content of each data element, padding left out."""
    place = 0
    while place + 8 <= len(data):
        kind, length = struct.unpack_from(f"{order}II", data, place)
        if kind >> 16:  # a small element: its length in the upper half of the first word, up to four bytes in the second
            kind, length = kind & 0xFFFF, kind >> 16
            start, end, step = place + 4, place + 4 + length, 8
        else:
            start, end = place + 8, place + 8 + length
            step = 8 + (length if kind == COMPRESSED else -(-length // 8) * 8)
        if end > len(data):
            raise ValueError("an element is cut short")
        yield kind, data[start:end]
        place += step


def _matrix(content: bytes, order: str) -> tuple[str, object]:
    """Return the name and the value of an array; None for a value of a kind that is not read."""
    elements = _elements(content, order)
    flags = struct.unpack_from(f"{order}I", next(elements)[1])[0]
    dimensions = np.frombuffer(next(elements)[1], f"{order}i4")
    name = next(elements)[1].decode("ascii", "replace")
    shape, kind = tuple(int(side) for side in dimensions), flags & 0xFF
    if kind == STRUCT:
        width = struct.unpack_from(f"{order}i", next(elements)[1])[0]
        packed = next(elements)[1]
        names = [packed[at:at + width].split(b"\0")[0].decode("ascii", "replace") for at in range(0, len(packed), width)]
        values = [_matrix(inner, order)[1] for _, inner in elements]
        return name, dict(zip(names, values, strict=True)) if len(values) == len(names) else None
    if kind == CELL:
        values = [_matrix(inner, order)[1] for _, inner in elements]
        texts = [value[0] for value in values if isinstance(value, tuple) and len(value) == 1]
        return name, tuple(texts) if texts and len(texts) == len(values) else None
    if kind == CHARACTERS:
        encoded, raw = next(elements)
        encoding = TEXTS[encoded]
        text = raw.decode(encoding if encoding == "utf-8" else f"{encoding}-{'le' if order == '<' else 'be'}")
        rows = np.array(list(text)).reshape(shape, order="F") if text and int(np.prod(shape)) == len(text) else None
        return name, tuple("".join(row).rstrip() for row in rows) if rows is not None and rows.ndim == 2 else None
    if not FIRST_NUMBER <= kind <= LAST_NUMBER or flags & COMPLEX:
        return name, None
    stored, raw = next(elements)
    numbers = np.frombuffer(raw, order + NUMBERS[stored])
    return name, numbers.astype(numbers.dtype.newbyteorder("="), copy=False).reshape(shape, order="F")
