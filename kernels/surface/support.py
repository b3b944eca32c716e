"""Normals as far as their standard errors support them: slopes that an unsure, grazing normal does not support make no spikes.

The slope of a normal n seen along v is (component across v) / n·v, which grows without bound towards grazing, and so does its error. The
surface is visible, so n·v is above 0, and among visible normals each is as frequent in an image as its n·v. The mean slope that this prior
leaves of a normal with standard error σ is the mean of the component across v over the mean of n·v, both over n·v > 0. Errors shorten the
mean of n to A = exp(-σ²/2); with s = σ sin θ / √2, the standard error of n·v,

    n·v  →  A n·v + s φ(a) / Φ(a),     a = A n·v / s,

the mean of a Gaussian cut at 0, and across v A times what it was. A sure normal keeps its direction: for a above 4 the change is below
0.0002 s.

The weight of the pair of two pixels is multiplied by HALF² / (HALF² + (σᵢ² + σⱼ²) / 2): among sure pixels the unsure ones follow.
"""

from typing import NamedTuple

import warp as wp

from kernels import device as devices

wp.set_module_options({"enable_backward": False})

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
