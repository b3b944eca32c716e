"""Reading and writing of hemispherical harmonics: `.rti` files of file type 3.

Four ASCII lines, each ended by carriage return and line feed (some readers count two bytes a line end, others take either):

    #HSH1.2 / 3 / width height 3 / terms 2 1

The lines give file type 3 (hemispherical harmonics), three colour channels, and 4, 9 or 16 terms; each channel has its own
coefficients (basis type 2), one byte each. `terms` scales and `terms` biases follow, little-endian float32, then the bytes, rows from
the top of the image to the bottom: at each pixel all terms of red, then green, then blue. A coefficient is byte/255 · scale + bias;
the sum is a display value with white at 1. The terms are those of kernels/relight/basis/rti.py.

Source: the file format of RTIBuilder and RTIViewer (Cultural Heritage Imaging, ISTI-CNR). The draft specification was not available: the
    layout is that of several independent readers and writers, which agree. The basis: Gautron et al., "A novel hemispherical basis
    for accurate and efficient rendering", Eurographics Symposium on Rendering 2004. No comment is written, because some readers do not
    skip lines that begin with #. The older `.hsh` files of RTIViewer have a binary header and are not written.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.errors import ImageError, storage
from stage.files import replacing
from stage.rti.quantization import TOP, Quantization

FILE_TYPE = 3
CHANNELS, SEPARATE, ELEMENT_SIZE = 3, 2, 1
TERMS = (4, 9, 16)


class Hsh(NamedTuple):
    """An image as quantised coefficients of hemispherical harmonics. Row 0 is the top of the image."""

    stored: np.ndarray  # [3, rows, cols, terms] uint8
    quantization: Quantization


def write(path: str | Path, hsh: Hsh) -> None:
    """Write an `.rti` file whole or not at all."""
    channels, rows, cols, terms = hsh.stored.shape
    header = f"#HSH1.2\r\n{FILE_TYPE}\r\n{cols} {rows} {channels}\r\n{terms} {SEPARATE} {ELEMENT_SIZE}\r\n"
    scale, bias = TOP * hsh.quantization.step, -hsh.quantization.zero * hsh.quantization.step
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header.encode("ascii"))
        stream.write(scale.astype("<f4").tobytes() + bias.astype("<f4").tobytes())
        for row in range(rows):
            stream.write(np.ascontiguousarray(np.swapaxes(hsh.stored[:, row], 0, 1)).tobytes())


def read(path: str | Path) -> Hsh:
    """Read an `.rti` file with separate coefficients of three channels, one byte each."""
    with storage("read", path):
        data = Path(path).read_bytes()
    lines: list[bytes] = []
    place = 0
    while len(lines) < 3 and (end := data.find(b"\n", place)) >= 0:
        if data[place : place + 1] != b"#":
            lines.append(data[place:end])
        place = end + 1
    if not data.startswith(b"#HSH") or len(lines) < 3:
        raise ImageError(f"{path}: is not an RTI file of hemispherical harmonics")
    try:
        (kind,), (cols, rows, channels), (terms, basis, size) = (tuple(map(int, line.split())) for line in lines)
    except ValueError as error:
        raise ImageError(f"{path}: has a damaged header: it holds file type, size and channels, terms and basis type") from error
    if (kind, channels, basis, size) != (FILE_TYPE, CHANNELS, SEPARATE, ELEMENT_SIZE) or terms not in TERMS or min(rows, cols) < 1:
        raise ImageError(f"{path}: is of file type {kind} with {channels} channels of {terms} terms, basis type {basis}: relit reads "
                         "type 3 with 3 separate channels of 4, 9 or 16")
    wanted = 8 * terms + rows * cols * channels * terms
    if len(data) - place != wanted:
        raise ImageError(f"{path}: holds {len(data) - place} bytes after its header, {cols}x{rows} with {terms} terms take {wanted}")
    numbers = np.array(struct.unpack_from(f"<{2 * terms}f", data, place), dtype=np.float64)
    step = numbers[:terms] / TOP
    zero = np.rint(-numbers[terms:] / np.where(step > 0, step, 1)).astype(int)
    stored = np.frombuffer(data, dtype=np.uint8, offset=place + 8 * terms).reshape(rows, cols, channels, terms)
    return Hsh(np.moveaxis(stored, 2, 0), Quantization(step.astype(np.float32), zero))
