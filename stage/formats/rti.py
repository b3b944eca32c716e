"""Files of reflectance transformation imaging (RTI): polynomial texture maps and hemispherical harmonics, of coefficients in bytes.

A coefficient is step · (byte − zero), with one step and one zero for each term of a file. The byte `zero` stands for the value 0, so that
pixels outside the mask are black.

**Hemispherical harmonics**: `.rti` files of file type 3. Four ASCII lines, each ended by carriage return and line feed (some readers count
two bytes a line end, others take either):

    #HSH1.2 / 3 / width height 3 / terms 2 1

The lines give file type 3 (hemispherical harmonics), three colour channels, and 4, 9 or 16 terms; each channel has its own
coefficients (basis type 2), one byte each. `terms` scales and `terms` biases follow, little-endian float32, then the bytes, rows from
the top of the image to the bottom: at each pixel all terms of red, then green, then blue. A coefficient is byte/255 · scale + bias;
the sum is a display value with white at 1. The terms are those of kernels/relight/basis/rti.py.

**Polynomial texture maps**: `.ptm` files of version 1.2, PTM_FORMAT_RGB and PTM_FORMAT_LRGB. Six ASCII lines, each ended by a line feed
(the specification lets width and height share a line; readers in use do not):

    PTM_1.2 / PTM_FORMAT_RGB or PTM_FORMAT_LRGB / width / height / six scales / six biases, whole numbers

Bytes follow, rows from the bottom of the image to the top. RGB: for red, then green, then blue, six
coefficients a pixel. LRGB: six coefficients of the luminance for all pixels, then red, green, blue for all pixels. A
coefficient is scale · (byte − bias) and belongs to u², v², u·v, u, v, 1, the light at u to the right and v up; the sum is a
display value with white at 255; in LRGB, divided by 255, it multiplies the colour. The format has no comments.

Source: the file format of RTIBuilder and RTIViewer (Cultural Heritage Imaging, ISTI-CNR). The draft specification was not available: the
    layout is that of several independent readers and writers, which agree. The basis: Gautron et al., "A novel hemispherical basis
    for accurate and efficient rendering", Eurographics Symposium on Rendering 2004. No comment is written, because some readers do not
    skip lines that begin with #. The older `.hsh` files of RTIViewer have a binary header and are not written.
    Malzbender, Gelb and Wolters, "Polynomial texture maps", SIGGRAPH 2001, section 3; Malzbender and Gelb, "Polynomial Texture Map
    (.ptm) File Format", version 1.2, Hewlett-Packard Laboratories 2001.
    Checked against independent descriptions of readers: header, order of terms, blocks and rows, and 255 as white. Some viewers
    truncate coefficients to whole numbers, which changes what they show by up to 4 of 255.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.files import replacing

TOP = 255
"""The largest byte."""
FILE_TYPE = 3
SEPARATE, ELEMENT_SIZE = 2, 1
RGB, LRGB = "PTM_FORMAT_RGB", "PTM_FORMAT_LRGB"


class Quantization(NamedTuple):
    """The step and the zero of each term."""

    step: np.ndarray  # [terms] float32, above 0
    zero: np.ndarray  # [terms] int, 0…255: the byte whose value is 0


def quantization_of_range(low: np.ndarray, high: np.ndarray) -> Quantization:
    """Return the quantisation that covers the range of the coefficients [terms] of each term, widened to contain 0."""
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    span = high - low
    step = np.where(span > 0, span / TOP, 1.0).astype(np.float32)
    return Quantization(step, np.clip(np.rint(-low / step), 0, TOP).astype(int))


def quantize(coefficients: np.ndarray, quantization: Quantization) -> np.ndarray:
    """Return the nearest byte of each coefficient [terms, …]; one outside the range takes the nearest end of the range."""
    shape = (-1,) + (1,) * (coefficients.ndim - 1)
    levels = np.rint(coefficients / quantization.step.reshape(shape)) + quantization.zero.reshape(shape)
    return np.clip(levels, 0, TOP).astype(np.uint8)


def dequantize(stored: np.ndarray, quantization: Quantization) -> np.ndarray:
    """Return the coefficients [terms, …] float32 of bytes [terms, …] uint8."""
    shape = (-1,) + (1,) * (stored.ndim - 1)
    zero = quantization.zero.reshape(shape).astype(np.float32)
    return (stored.astype(np.float32) - zero) * quantization.step.reshape(shape)


class Hsh(NamedTuple):
    """An image as quantised coefficients of hemispherical harmonics. Row 0 is the top of the image."""

    stored: np.ndarray  # [3, rows, cols, terms] uint8
    quantization: Quantization


def write_hsh(path: str | Path, hsh: Hsh) -> None:
    """Write an `.rti` file whole or not at all."""
    channels, rows, cols, terms = hsh.stored.shape
    header = f"#HSH1.2\r\n{FILE_TYPE}\r\n{cols} {rows} {channels}\r\n{terms} {SEPARATE} {ELEMENT_SIZE}\r\n"
    scale, bias = TOP * hsh.quantization.step, -hsh.quantization.zero * hsh.quantization.step
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header.encode("ascii"))
        stream.write(scale.astype("<f4").tobytes() + bias.astype("<f4").tobytes())
        for row in range(rows):
            stream.write(np.ascontiguousarray(np.swapaxes(hsh.stored[:, row], 0, 1)).tobytes())


class Ptm(NamedTuple):
    """A polynomial texture map with quantised coefficients. Row 0 is the top of the image."""

    stored: np.ndarray  # [channels, rows, cols, 6] uint8; 3 channels, or 1 for the luminance
    quantization: Quantization
    colour: np.ndarray | None  # [rows, cols, 3] uint8, the colour beside a luminance, or None


def write_ptm(path: str | Path, ptm: Ptm) -> None:
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
