"""Slow float64 twins of the bases of a stack, and readers of PTM and RTI files written from the published layouts alone.

Malzbender and Gelb 2001 (.ptm version 1.2), the .rti layout of RTIBuilder and RTIViewer, Gautron et al. 2004 (hemispherical
harmonics from Legendre polynomials), IEC 61966-2-1 (sRGB). They import nothing of ours.
"""

import math
import struct

import numpy as np
from numpy.polynomial import Legendre


def truncation(images, count):
    """[channel] relative RMS error of the best `count` images; images [channel, light, pixel]."""
    errors = []
    for plane in images.astype(np.float64):
        squares = np.linalg.svd(plane, compute_uv=False) ** 2
        errors.append(math.sqrt(squares[count:].sum() / squares.sum()))
    return np.array(errors)


def polynomial(directions):
    """[light, 6] in the order of a PTM."""
    return np.array([[x * x, y * y, x * y, x, y, 1.0] for x, y, _ in directions])


def harmonics(directions, terms):
    """[light, terms]: order by order; cosines from the highest m down, the axis, sines up; minus for even m above 0."""
    rows = []
    for x, y, z in np.asarray(directions, dtype=np.float64):
        azimuth, row = math.atan2(y, x), []
        for order in range(math.isqrt(terms)):
            for m in range(-order, order + 1):
                size = abs(m)
                t = 2 * z - 1
                legendre = Legendre.basis(order).deriv(size)(t) if size else Legendre.basis(order)(t)
                value = math.sqrt((2 * order + 1) * math.factorial(order - size) / (2 * math.pi * math.factorial(order + size)))
                value *= max(1 - t * t, 0) ** (size / 2) * legendre
                if size:
                    turn = math.cos(size * azimuth) if m < 0 else math.sin(size * azimuth)
                    value *= math.sqrt(2) * turn * (-1 if size % 2 == 0 else 1)
                row.append(value)
        rows.append(row)
    return np.array(rows)


def render_ptm(data, directions):
    """[light, rows, cols, 3] values 0…1 that a viewer shows of the bytes of a .ptm file; row 0 on top."""
    version, name, width, height, scales, biases, body = data.split(b"\n", 6)
    assert version == b"PTM_1.2"
    cols, rows = int(width), int(height)
    scale, bias = np.array([float(s) for s in scales.split()]), np.array([int(b) for b in biases.split()])
    values = np.frombuffer(body, dtype=np.uint8).astype(np.float64)
    terms = polynomial(directions)
    if name == b"PTM_FORMAT_RGB":
        assert len(values) == 18 * rows * cols
        coefficients = (values.reshape(3, rows, cols, 6)[:, ::-1] - bias) * scale
        shown = np.einsum("lt,crxt->lrxc", terms, coefficients)
    else:
        assert name == b"PTM_FORMAT_LRGB" and len(values) == 9 * rows * cols
        coefficients = (values[: 6 * rows * cols].reshape(rows, cols, 6)[::-1] - bias) * scale
        colour = values[6 * rows * cols :].reshape(rows, cols, 3)[::-1]
        shown = np.einsum("lt,rxt->lrx", terms, coefficients)[..., None] / 255 * colour
    return np.clip(shown / 255, 0, 1)


def render_rti(data, directions):
    """[light, rows, cols, 3] values 0…1 that a viewer shows of the bytes of an .rti file of hemispherical harmonics; row 0 on top."""
    head, kind, size, layout, body = data.split(b"\r\n", 4)
    assert head == b"#HSH1.2" and kind == b"3"
    cols, rows, channels = map(int, size.split())
    terms, basis, element = map(int, layout.split())
    assert (channels, basis, element) == (3, 2, 1)
    scale = np.array(struct.unpack_from(f"<{terms}f", body))
    bias = np.array(struct.unpack_from(f"<{terms}f", body, 4 * terms))
    values = np.frombuffer(body, dtype=np.uint8, offset=8 * terms)
    assert len(values) == rows * cols * 3 * terms
    coefficients = values.reshape(rows, cols, 3, terms) / 255 * scale + bias
    return np.clip(np.einsum("lt,rxct->lrxc", harmonics(directions, terms), coefficients), 0, 1)


def relative_rms(shown, wanted):
    """Root mean square of the difference over that of what is wanted."""
    return math.sqrt(((shown - wanted) ** 2).sum() / (wanted**2).sum())
