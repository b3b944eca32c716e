"""Reading and writing of polynomial texture maps: `.ptm` files of version 1.2, PTM_FORMAT_RGB and PTM_FORMAT_LRGB.

Six ASCII lines, each ended by a line feed (the specification lets width and height share a line; readers in use do not):

    PTM_1.2 / PTM_FORMAT_RGB or PTM_FORMAT_LRGB / width / height / six scales / six biases, whole numbers

Bytes follow, rows from the bottom of the image to the top. RGB: for red, then green, then blue, six
coefficients a pixel. LRGB: six coefficients of the luminance for all pixels, then red, green, blue for all pixels. A
coefficient is scale · (byte − bias) and belongs to u², v², u·v, u, v, 1, the light at u to the right and v up; the sum is a
display value with white at 255; in LRGB, divided by 255, it multiplies the colour. The format has no comments.

Source: Malzbender, Gelb and Wolters, "Polynomial texture maps", SIGGRAPH 2001, section 3; Malzbender and Gelb, "Polynomial Texture Map
    (.ptm) File Format", version 1.2, Hewlett-Packard Laboratories 2001.
    Checked against independent descriptions of readers: header, order of terms, blocks and rows, and 255 as white. Some viewers
    truncate coefficients to whole numbers, which changes what they show by up to 4 of 255.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.errors import ImageError, storage
from stage.files import replacing
from stage.rti.quantization import Quantization

TERMS = 6
RGB, LRGB = "PTM_FORMAT_RGB", "PTM_FORMAT_LRGB"
HEADER_LINES = 6


class Ptm(NamedTuple):
    """A polynomial texture map with quantised coefficients. Row 0 is the top of the image."""

    stored: np.ndarray  # [channels, rows, cols, 6] uint8; 3 channels, or 1 for the luminance
    quantization: Quantization
    colour: np.ndarray | None  # [rows, cols, 3] uint8, the colour beside a luminance, or None


def write(path: str | Path, ptm: Ptm) -> None:
    """Write a `.ptm` file whole or not at all: RGB for three channels, LRGB for a luminance and colours."""
    channels, rows, cols, _ = ptm.stored.shape
    name = RGB if channels == 3 else LRGB
    scales = " ".join(np.format_float_positional(step, unique=True, trim="0") for step in ptm.quantization.step)
    biases = " ".join(str(int(zero)) for zero in ptm.quantization.zero)
    header = f"PTM_1.2\n{name}\n{cols}\n{rows}\n{scales}\n{biases}\n"
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header.encode("ascii"))
        for channel in ptm.stored:
            for row in channel[::-1]:
                stream.write(np.ascontiguousarray(row).tobytes())
        if ptm.colour is not None:
            for row in ptm.colour[::-1]:
                stream.write(np.ascontiguousarray(row).tobytes())


def read(path: str | Path) -> Ptm:
    """Read an uncompressed `.ptm` file, RGB or LRGB."""
    with storage("read", path):
        data = Path(path).read_bytes()
    *lines, body = data.split(b"\n", HEADER_LINES) if data.count(b"\n") >= HEADER_LINES else [b""]
    if not lines or lines[0].strip() != b"PTM_1.2":
        raise ImageError(f"{path}: is not a PTM file of version 1.2")
    name = lines[1].strip().decode("ascii", "replace")
    if name not in (RGB, LRGB):
        raise ImageError(f"{path}: is {name[:40]}: relit reads {RGB} and {LRGB}")
    try:
        cols, rows = int(lines[2]), int(lines[3])
        step, zero = np.array(lines[4].split(), dtype=np.float32), np.array([int(bias) for bias in lines[5].split()])
    except ValueError as error:
        raise ImageError(f"{path}: has a damaged header: lines 3 to 6 are width, height, scales and biases") from error
    if rows < 1 or cols < 1 or step.shape != (TERMS,) or zero.shape != (TERMS,):
        raise ImageError(f"{path}: has a damaged header: lines 3 to 6 are width, height, six scales and six biases")
    channels, colours = (3, 0) if name == RGB else (1, 3)
    pixels = rows * cols
    if len(body) != pixels * (channels * TERMS + colours):
        raise ImageError(f"{path}: holds {len(body)} bytes of pixels, {cols}x{rows} take {pixels * (channels * TERMS + colours)}")
    values = np.frombuffer(body, dtype=np.uint8)
    stored = values[: pixels * channels * TERMS].reshape(channels, rows, cols, TERMS)[:, ::-1]
    colour = values[pixels * TERMS :].reshape(rows, cols, 3)[::-1] if colours else None
    return Ptm(stored, Quantization(step, zero), colour)
