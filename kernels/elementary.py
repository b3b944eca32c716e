"""The logarithm, angles, sines and cosines by arithmetic alone: a loop over a pack then becomes SIMD instructions, where libm would be
called once for each lane."""

import math

import warp as wp

EIGHTH = 0.41421356237
"""tan(π/8): a larger quotient is first turned by π/4, so that the polynomial stays accurate."""
QUARTER_TURN = 0.5 * math.pi
"""A quarter of a turn in radians."""
HALF_TURN = math.pi
"""Half a turn in radians."""
TURN = 2.0 * math.pi
"""A turn in radians."""
MANTISSA_BITS = wp.constant(23)
ROOT_OF_HALF_BITS = wp.constant(0x3F3504F3)
"""Bits of √½ as a float: the mantissa is taken between √½ and √2, where the polynomial is close."""


@wp.func
def angle_of(x: float, y: float) -> float:
    """Return atan2(y, x), 0 to 2π, within 4e-7; 0 for the zero vector.

    Source: Moshier, Cephes Mathematical Library, atanf (odd polynomial of degree nine up to tan π/8).
    """
    across, up = wp.abs(x), wp.abs(y)
    small, large = wp.min(across, up), wp.max(across, up)
    turned = wp.where(small > EIGHTH * large, 1.0, 0.0)
    q = (small - turned * large) / (large + turned * small + 1.0e-30)
    z = q * q
    angle = ((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z - 3.33329491539e-1
    angle = angle * z * q + q + turned * (0.5 * QUARTER_TURN)
    steep = wp.where(up > across, 1.0, 0.0)
    angle = angle + steep * (QUARTER_TURN - 2.0 * angle)
    left = wp.where(x < 0.0, 1.0, 0.0)
    angle = angle + left * (HALF_TURN - 2.0 * angle)
    below = wp.where(y < 0.0, 1.0, 0.0)
    return angle + below * (TURN - 2.0 * angle)


@wp.func
def sine_quarter(t: float) -> float:
    """Return sin 2πt for |t| of a quarter of a turn at most, within 1e-7: Taylor's polynomial of degree eleven."""
    x = TURN * t
    z = x * x
    series = ((((-2.5052108e-8 * z + 2.7557319e-6) * z - 1.98412698e-4) * z + 8.33333333e-3) * z - 1.66666667e-1) * z
    return x + x * series


@wp.func
def cosine_of_turns(t: float) -> float:
    """Return cos 2πt, within 2e-7 for small t; the rounding of t itself is added for large."""
    return sine_quarter(0.25 - wp.abs(t - wp.floor(t + 0.5)))


@wp.func
def sine_of_turns(t: float) -> float:
    """Return sin 2πt, as cosine_of_turns does."""
    return cosine_of_turns(t - 0.25)


@wp.func
def log_of(x: float) -> float:
    """Return the natural logarithm of a positive, normal number, to 1.2e-7 of it or absolutely, whichever is larger.

    Source: Moshier, Cephes Mathematical Library, logf.c (the polynomial and the parts of ln 2).
    """
    bits = wp.cast(x, wp.int32)
    exponent = (bits - ROOT_OF_HALF_BITS) >> MANTISSA_BITS
    m = wp.cast(bits - (exponent << MANTISSA_BITS), wp.float32) - 1.0
    m2 = m * m
    y = 7.0376836292e-2 * m - 1.1514610310e-1
    y = y * m + 1.1676998740e-1
    y = y * m - 1.2420140846e-1
    y = y * m + 1.4249322787e-1
    y = y * m - 1.6668057665e-1
    y = y * m + 2.0000714765e-1
    y = y * m - 2.4999993993e-1
    y = y * m + 3.3333331174e-1
    e = float(exponent)
    return e * 0.693359375 + (m + (y * m * m2 - 2.12194440e-4 * e - 0.5 * m2))
