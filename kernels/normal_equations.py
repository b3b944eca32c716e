"""The normal equations G x = r of three unknowns, with G = Σ w l lᵀ and r = Σ w y l: the least-squares solution of l·x = y.

A Lambertian pixel is b·l = y with b = albedo / π · normal (Woodham 1980, equation 8, overdetermined). Independent errors of variance s² in
the readings give b the covariance s² G⁻¹, which is taken across the normal.
"""

import warp as wp

from kernels.status import DARK, ILL_POSED, OK, TOO_FEW_LIGHTS

MIN_DETERMINANT = 1.0e-6
"""Least 27·det(G)/tr(G)³, which is 1 for evenly spread lights: lights within about one degree of a point have less."""
MIN_OFF_CIRCLE = 7.6e-5
"""Least det(g) over the sum of its principal minors, g = G/tr(G): the mean square sine by which lights leave a great circle, here
half a degree. Float32 sums leave up to 1e-7 of exactly coplanar lights, and noise leaves nothing of such a normal."""
MIN_EXPLAINED = 1.0e-6
"""Least part of Σ w y² that b·l explains: a pixel with less is equally bright from every side, and its readings give no direction."""


@wp.func
def add_reading(y: float, w: float, lx: float, ly: float, lz: float,
                xx: wp.ref[float], xy: wp.ref[float], xz: wp.ref[float], yy: wp.ref[float], yz: wp.ref[float], zz: wp.ref[float],
                rx: wp.ref[float], ry: wp.ref[float], rz: wp.ref[float], squares: wp.ref[float]):
    """Add a reading y of weight w to one pixel's normal equations: G += w l lᵀ, r += w y l, and w y² to the sum of squares.

    The sums are lanes of packs that the kernel holds, passed one by one: Warp copies a pack whenever a struct or a matrix of packs is
    indexed, which is twenty times slower on the CPU.
    """
    squares += w * y * y
    rx += w * y * lx
    ry += w * y * ly
    rz += w * y * lz
    xx += w * lx * lx
    xy += w * lx * ly
    xz += w * lx * lz
    yy += w * ly * ly
    yz += w * ly * lz
    zz += w * lz * lz


@wp.func
def symmetric(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> wp.mat33:
    """Return the symmetric matrix with these entries."""
    return wp.mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)


@wp.struct
class LambertFit:
    """Least-squares fit of one pixel."""

    b: wp.vec3  # albedo / π · normal
    across: float  # trace of G⁻¹ across the normal: variance of the normal, radians², for residuals of variance |b|²
    residual: float  # Σ w (y - b·l)² / |b|²
    status: int


@wp.func
def fit_pixel(g: wp.mat33, r: wp.vec3, squares: float, count: int) -> LambertFit:
    """Solve one pixel: g, r are its normal equations, squares Σ w y², count the readings that were used."""
    fit = LambertFit()
    if count < 3:
        fit.status = wp.where(count == 0, DARK, TOO_FEW_LIGHTS)
        return fit
    trace = g[0, 0] + g[1, 1] + g[2, 2]
    unit = g / wp.max(trace, 1.0e-30)  # a pure number, whatever the weights
    determinant = wp.determinant(unit)
    minors = unit[0, 0] * unit[1, 1] + unit[0, 0] * unit[2, 2] + unit[1, 1] * unit[2, 2] - (
        unit[0, 1] * unit[0, 1] + unit[0, 2] * unit[0, 2] + unit[1, 2] * unit[1, 2])
    if 27.0 * determinant < MIN_DETERMINANT or determinant < MIN_OFF_CIRCLE * minors:
        fit.status = ILL_POSED
        return fit
    inverse = wp.inverse(unit)
    b = inverse * (r / trace)
    if wp.dot(b, r) <= MIN_EXPLAINED * squares:
        fit.status = ILL_POSED
        return fit
    length = wp.max(wp.length(b), 1.0e-30)
    n = b / length
    fit.b = b
    fit.across = wp.max((wp.trace(inverse) - wp.dot(n, inverse * n)) / trace, 0.0)
    # the difference cancels: in float32 an RMS residual below about 5e-4 |b|, twice half rounding, is that of the sums
    fit.residual = wp.max(squares - wp.dot(b, r), 0.0) / (length * length)
    fit.status = OK
    return fit
