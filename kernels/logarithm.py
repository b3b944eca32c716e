"""The natural logarithm as arithmetic that the compiler does for several pixels at once; `wp.log` calls a library for each of them."""

import warp as wp

MANTISSA_BITS = wp.constant(23)
ROOT_OF_HALF_BITS = wp.constant(0x3F3504F3)
"""Bits of √½ as a float: the mantissa is taken between √½ and √2, where the polynomial is close."""


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
