"""A stack as a display shows it: exposed, in the display's primaries, clipped at white and encoded with the sRGB curve.

Viewers of relightable images fit and show such values: theirs are 8-bit pictures of a camera.

Source: IEC 61966-2-1:1999, equations for the sRGB transfer function.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type, zeros


def encode(band: Band, gains: np.ndarray, display_from_stack: np.ndarray) -> Band:
    """Encode every stored image for a display.

    Args:
        band: the stack on the device.
        gains: [3, lights] exposed scene-linear radiance of a stored 1.0; 0 for padding and for lights to leave out.
        display_from_stack: [3, 3] linear RGB of the display from that of the stack; white is 1.

    Returns:
        A band of the same shape: 0…1, half (off by at most 1/16 of an 8-bit step); not synchronised on CUDA.

    Raises:
        ArrayError: gains or matrix of another shape, or not finite.
    """
    band.require_channels(3)
    for name, array, shape in (("gains", gains, (3, band.frame_count)), ("display_from_stack", display_from_stack, (3, 3))):
        if array.shape != shape or not np.isfinite(array).all():
            raise ArrayError(f"{name} are {array.shape}, expected {shape} finite values")
    device = band.device
    pack = devices.pack_width(device)
    encoded = zeros(band.pixel_count, wp.float16, device, rows=3 * band.frame_count)
    on_device = wp.array(gains, dtype=wp.float32, device=device)
    matrix = wp.mat33(*(float(v) for v in np.asarray(display_from_stack, dtype=np.float32).reshape(-1)))
    packed = as_packs(encoded, device)
    devices.launch(encode_kernel(pack), band.frame_count * band.packs, [band.values, on_device, matrix], [packed], device=device)
    return Band(packed, band.saturated, band.pixel_count, band.frame_count, device, (*band.owner, encoded))


@wp.func
def srgb(linear: float) -> float:
    """Return the sRGB curve of a value limited to 0…1."""
    value = wp.clamp(linear, 0.0, 1.0)
    if value <= 0.0031308:
        return 12.92 * value
    return 1.055 * wp.pow(value, 1.0 / 2.4) - 0.055


@cache
def encode_kernel(pack: int) -> Any:
    """Return the kernel: one thread for a pack of one light, all three channels."""
    half_pack = pack_type(pack, wp.float16)

    @wp.kernel(enable_backward=False, module="unique")
    def encode_display(first: int,
                       values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                       gains: wp.array2d(dtype=float),  # [3, L]
                       display_from_stack: wp.mat33,
                       # outputs
                       encoded: wp.array2d(dtype=half_pack)):  # [3 · L, P] 0…1
        thread = first + wp.tid()
        packs = values.shape[1]
        light = thread / packs
        p = thread % packs
        lights = gains.shape[1]
        gain = wp.vec3(gains[0, light], gains[1, light], gains[2, light])
        red = values[light, p]
        green = values[lights + light, p]
        blue = values[2 * lights + light, p]
        r, g, b = half_pack(), half_pack(), half_pack()
        for k in range(pack):
            scene = wp.cw_mul(gain, wp.vec3(float(red[k]), float(green[k]), float(blue[k])))
            shown = display_from_stack * scene
            r[k] = wp.float16(srgb(shown[0]))
            g[k] = wp.float16(srgb(shown[1]))
            b[k] = wp.float16(srgb(shown[2]))
        encoded[light, p] = r
        encoded[lights + light, p] = g
        encoded[2 * lights + light, p] = b

    return encode_display
