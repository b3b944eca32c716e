"""What a basis leaves of a stack: squared differences of images rebuilt from coefficients, at every pixel."""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type, zeros


def squared_residual(band: Band, gains: np.ndarray, coefficients: np.ndarray, functions: np.ndarray, *,
                     low: float = -np.inf, high: float = np.inf) -> wp.array:
    """Return Σ over the lights of (image − rebuilt image)² at each pixel.

    Args:
        band: the stack on the device.
        gains: [3, lights padded] float32; image = gain · stored value. 0 for lights that do not count.
        coefficients: [terms, 3, pixels padded] float32.
        functions: [3, lights padded, terms]; rebuilt image = Σ function · coefficient. 0 for lights that do not count.
        low, high: what a rebuilt value is limited to, as a display does; 0 must lie between.

    Returns:
        [3, pixels padded] float32 on the device; not synchronised on CUDA. Differences are taken in float: below 1e-6 of the
        image they are rounding.

    Raises:
        ArrayError: shapes that do not fit.
    """
    band.require_channels(3)
    pack, device = devices.pack_width(band.device), band.device
    terms, pixels = len(coefficients), band.packs * pack
    wanted = {"gains": (gains, (3, band.frame_count)), "coefficients": (coefficients, (terms, 3, pixels)),
              "functions": (functions, (3, band.frame_count, terms))}
    for name, (array, shape) in wanted.items():
        if array.shape != shape:
            raise ArrayError(f"{name} are {array.shape}, expected {shape}")
    on_device = wp.array(coefficients, dtype=wp.float32, device=device)
    small = [wp.array(a, dtype=wp.float32, device=device) for a in (gains, functions)]
    squares = zeros(band.pixel_count, wp.float32, device, rows=3)
    devices.launch(residual_kernel(pack), 3 * band.packs, [band.values, small[0], as_packs(on_device, device), small[1], low, high],
                   [as_packs(squares, device)], device=device)
    return squares


@cache
def residual_kernel(pack: int) -> Any:
    """Return the kernel: one thread for a pack of one channel."""
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def residual(first: int,
                 values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                 gains: wp.array2d(dtype=float),  # [3, L]
                 coefficients: wp.array3d(dtype=float_pack),  # [T, 3, P]
                 functions: wp.array3d(dtype=float),  # [3, L, T]
                 low: float,
                 high: float,
                 # outputs
                 squares: wp.array2d(dtype=float_pack)):  # [3, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        channel = thread / packs
        p = thread % packs
        total = float_pack()
        for light in range(gains.shape[1]):
            rebuilt = float_pack()
            for t in range(functions.shape[2]):
                rebuilt += functions[channel, light, t] * coefficients[t, channel, p]
            value = values[channel * gains.shape[1] + light, p]
            gain = gains[channel, light]
            for k in range(pack):
                difference = wp.clamp(rebuilt[k], low, high) - gain * float(value[k])
                total[k] += difference * difference
        squares[channel, p] = total

    return residual
