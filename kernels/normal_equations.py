"""The normal equations G x = r of three unknowns, with G = Σ w l lᵀ and r = Σ w y l: the least-squares solution of l·x = y."""

import warp as wp


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
