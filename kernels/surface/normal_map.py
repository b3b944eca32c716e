"""Normals of a surface on the host, which an integration reads a band of rows at a time, or at some pixels.

An image has tens of millions of pixels: what follows from one normal alone is found again where it is needed, and not kept.

The slope of a normal n seen along v is (component across v) / n·v, which grows without bound towards grazing, and so does its error. The
surface is visible, so n·v is above 0, and among visible normals each is as frequent in an image as its n·v. The mean slope that this prior
leaves of a normal with standard error σ is the mean of the component across v over the mean of n·v, both over n·v > 0. Errors shorten the
mean of n to A = exp(-σ²/2); with s = σ sin θ / √2, the standard error of n·v,

    n·v  →  A n·v + s φ(a) / Φ(a),     a = A n·v / s,

the mean of a Gaussian cut at 0, and across v A times what it was. A sure normal keeps its direction: for a above 4 the change is below
0.0002 s.

The weight of the pair of two pixels is multiplied by HALF² / (HALF² + (σᵢ² + σⱼ²) / 2): among sure pixels the unsure ones follow.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy

HALF = 0.17453293
"""Standard error, radians (ten degrees), at which the weight of a pair is halved. Between 5° and 20° heights differ by a thirtieth of their
error."""

_HALF_SQUARED = wp.constant(wp.float32(HALF**2))


class Supported(NamedTuple):
    """Normals as far as they are supported, and the weight of each."""

    normal: wp.array  # [3, rows, cols] float32; its direction is what counts
    trust: wp.array  # [rows, cols] float32, 0…1


@wp.kernel
def _support(first: int,
             normal: wp.array3d(dtype=wp.float32),
             sigma: wp.array2d(dtype=wp.float32),
             x: wp.array2d(dtype=wp.float32),
             y: wp.array2d(dtype=wp.float32),
             perspective: wp.float32,
             # outputs
             supported: wp.array3d(dtype=wp.float32),
             trust: wp.array2d(dtype=wp.float32)):
    p = first + wp.tid()
    r = p // sigma.shape[1]
    c = p - r * sigma.shape[1]
    n = wp.vec3(normal[0, r, c], normal[1, r, c], normal[2, r, c])
    toward = wp.normalize(wp.vec3(-perspective * x[r, c], -perspective * y[r, c], 1.0))
    facing = wp.dot(n, toward)
    shortened = wp.exp(-0.5 * sigma[r, c] * sigma[r, c])
    s = sigma[r, c] * wp.sqrt(wp.max(wp.dot(n, n) - facing * facing, 0.0) * 0.5) / shortened
    if s > 0.0:
        a = facing / s
        n += s * wp.exp(-0.5 * a * a) * 0.39894228 / wp.max(0.5 * wp.erfc(-a * 0.70710678), 1.0e-6) * toward
    supported[0, r, c] = n[0]
    supported[1, r, c] = n[1]
    supported[2, r, c] = n[2]
    trust[r, c] = _HALF_SQUARED / (_HALF_SQUARED + sigma[r, c] * sigma[r, c])


def supported_normals(
    normal: wp.array,  # [3, rows, cols] float32, camera frame
    sigma: wp.array,  # [rows, cols] float32, radians
    x: wp.array,  # [rows, cols] float32, right, in the plane of the projection
    y: wp.array,  # [rows, cols] float32, up
    *,
    perspective: bool,
    device: str,
) -> Supported:
    """Return normals as far as their standard errors support their slopes."""
    found = Supported(wp.empty_like(normal), wp.empty_like(sigma))
    devices.launch(_support, sigma.shape[0] * sigma.shape[1], [normal, sigma, x, y, float(perspective)], list(found), device=device)
    return found


SHORTEST_NORMAL = 0.5
"""Least length of a vector that counts as a normal: half storage shortens one by 0.001, and an unsolved pixel holds zeros."""
BAND_PIXELS = 1 << 19
"""Number of pixels of a band: it bounds the memory."""


class NormalBand(NamedTuple):
    """Some rows of a surface on the device."""

    first: int  # row of the image that row 0 of the arrays is
    rows: int  # of the band; the arrays have one row more, where the image has
    normal: wp.array  # [3, rows + 1, cols] float32, as far as its standard error supports it
    usable: wp.array  # [rows + 1, cols] uint8
    x: wp.array  # [rows + 1, cols] float32
    y: wp.array
    trust: wp.array  # [rows + 1, cols] float32, 0…1, the weight of each pixel


class PixelNormals(NamedTuple):
    """The normals of some pixels on the host."""

    normal: np.ndarray  # [3, n] float32, unit, as far as its standard error supports it; 0 outside the image
    ray: np.ndarray  # [2, n] float32, x and y of the pixel in the plane of projection


@wp.kernel
def _mark_usable(first: int,
                 normal: wp.array3d(dtype=wp.float32),  # [3, rows, cols]
                 mask: wp.array2d(dtype=wp.uint8),
                 x: wp.array2d(dtype=wp.float32),
                 y: wp.array2d(dtype=wp.float32),
                 # outputs
                 usable: wp.array2d(dtype=wp.uint8)):
    p = first + wp.tid()
    r = p // mask.shape[1]
    c = p - r * mask.shape[1]
    n = wp.vec3(normal[0, r, c], normal[1, r, c], normal[2, r, c])
    length = wp.length(n)
    good = mask[r, c] != wp.uint8(0) and wp.isfinite(length) and length > SHORTEST_NORMAL
    if good and wp.isfinite(x[r, c]) and wp.isfinite(y[r, c]):
        usable[r, c] = wp.uint8(1)
    else:
        usable[r, c] = wp.uint8(0)


class NormalMap:
    """Normals with their pixels' places and standard errors.

    Args:
        normal: [3, rows, cols] float32, camera frame.
        x: [rows, cols] plane coordinates of the pixels, to the right; may be a view of one row.
        y: the same, upwards.
        sigma: [rows, cols] standard errors of the normals, degrees; None: all are sure.
        perspective: whether x and y are slopes of rays rather than positions.
    """

    def __init__(self, normal: np.ndarray, mask: np.ndarray, x: np.ndarray, y: np.ndarray, sigma: np.ndarray | None, *,
                 perspective: bool, device: str):
        self._normal, self._mask, self._x, self._y, self._sigma = normal, mask, x, y, sigma
        self.perspective, self.device = perspective, device
        self.rows, self.cols = mask.shape
        self._sent: list[NormalBand] = []

    def bands(self) -> Iterable[NormalBand]:
        """Return the surface on the device band by band, from the first row to the last; on CUDA it is sent once."""
        if self.device == "cpu":
            return self._bands()
        self._sent = self._sent or list(self._bands())
        return self._sent

    def _bands(self) -> Iterator[NormalBand]:
        step = max(1, BAND_PIXELS // self.cols)
        for first in range(0, self.rows, step):
            part = slice(first, min(first + step, self.rows) + 1)
            normal, x, y = self._floats(self._normal[:, part]), self._floats(self._x[part]), self._floats(self._y[part])
            inside = np.ascontiguousarray((self._mask[part] != 0).view(np.uint8))
            usable = wp.empty(inside.shape, dtype=wp.uint8, device=self.device)
            devices.launch(_mark_usable, inside.size, [normal, wp.array(inside, dtype=wp.uint8, device=self.device), x, y], [usable],
                           device=self.device)
            rows = min(step, self.rows - first)
            if self._sigma is None:
                yield NormalBand(first, rows, normal, usable, x, y, wp.ones(inside.shape, dtype=wp.float32, device=self.device))
            else:
                supported = supported_normals(normal, self._floats(_radians(self._sigma[part])), x, y, perspective=self.perspective,
                                              device=self.device)
                yield NormalBand(first, rows, supported.normal, usable, x, y, supported.trust)

    def at(self, row: np.ndarray, col: np.ndarray) -> PixelNormals:
        """Return the unit normals of some pixels, which may lie outside the image; waits for the device."""
        inside = (row >= 0) & (row < self.rows) & (col >= 0) & (col < self.cols)
        place = np.where(inside, row, 0), np.where(inside, col, 0)
        normal = np.stack([plane[place] for plane in self._normal]).astype(np.float32)
        ray = np.stack([plane[place] for plane in (self._x, self._y)]).astype(np.float32)
        if self._sigma is not None and len(row):
            line = self._floats(normal[:, None]), *(self._floats(values[None]) for values in (_radians(self._sigma[place]), *ray))
            normal = to_numpy(supported_normals(*line, perspective=self.perspective, device=self.device).normal)[:, 0]
        normal, ray = (np.where(inside, np.nan_to_num(values), 0) for values in (normal, ray))
        return PixelNormals(normal / np.maximum(np.linalg.norm(normal, axis=0), 1e-9), ray)

    def _floats(self, values: np.ndarray) -> wp.array:
        """Return float32 values on the device, without a copy where they are on it already."""
        return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=wp.float32, device=self.device, copy=False)


def _radians(degrees: np.ndarray) -> np.ndarray:
    return np.radians(degrees, dtype=np.float32)
