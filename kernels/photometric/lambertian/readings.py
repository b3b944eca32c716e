"""Input of every photometric solver: the lights as arrays, and one grey reading per light and pixel.

A grey reading is a weighted sum over the channels of radiance / irradiance, so that for a Lambertian surface it is b·l with
b = albedo / π · normal, whatever the strength and colour of the lights. A reading of zero or less, or a saturated one, bounds
the radiance but does not measure it, and one that is not finite says nothing: it is stored as 0, which means "no reading".
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once, to_numpy
from kernels.errors import ArrayError
from kernels.pack_access import pack_load, pack_store
from kernels.packs import Band, new_array, pack_type

UNIT_TOLERANCE = 1e-3
"""Largest difference of a light direction's length from one."""
CHUNK = 32
"""Packs that one CPU thread takes: it reads 512 bytes of one light's row after another, which the hardware prefetcher follows."""
LARGEST = 1.0e15
"""Grey reading above which a reading counts as infinite: the solvers square readings and add them up in float32."""


class Lights(NamedTuple):
    """Distant lights of a stack, padded as its light axis is; padding has zero irradiance."""

    direction: np.ndarray  # [lights, 3] float32, unit, from the surface to the light
    irradiance: np.ndarray  # [lights, 3] float32, relative, at normal incidence
    scale: np.ndarray  # [lights] float32, radiance of a stored 1.0


def pad_lights(direction: np.ndarray, irradiance: np.ndarray, scale: np.ndarray | None = None) -> Lights:
    """Check distant lights and pad them to a multiple of 8.

    Args:
        direction: [n, 3] unit vectors from the surface to the light.
        irradiance: [n, 3] above or equal 0, not all zero for a light.
        scale: [n] or already padded; radiance of a stored 1.0; None: 1.

    Raises:
        ArrayError: shapes that do not fit, a direction that is not a unit vector, a light without irradiance, a scale that is
            negative or not finite.
    """
    direction = np.asarray(direction, dtype=np.float32)
    irradiance = np.asarray(irradiance, dtype=np.float32)
    count = len(direction)
    if direction.shape != (count, 3) or irradiance.shape != (count, 3) or count == 0:
        raise ArrayError(f"direction is {direction.shape}, irradiance {irradiance.shape}: give one row of three per light")
    length = np.linalg.norm(direction, axis=1)
    if not (np.abs(length - 1) < UNIT_TOLERANCE).all():
        raise ArrayError(f"direction of light {int(np.argmax(np.abs(length - 1)))} is not a unit vector")
    if not np.isfinite(irradiance).all() or (irradiance < 0).any() or not irradiance.any(axis=1).all():
        raise ArrayError("irradiance must be finite, not negative, and above 0 in some channel of every light")
    lights = -(-count // 8) * 8
    extra = ((0, lights - count), (0, 0))
    scale = np.ones(count, dtype=np.float32) if scale is None else np.asarray(scale, dtype=np.float32)
    if scale.shape not in ((count,), (lights,)):
        raise ArrayError(f"scale is {scale.shape} for {count} lights: give one per light, or per padded light ({lights})")
    if not np.isfinite(scale).all() or (scale < 0).any():
        raise ArrayError("scale must be finite and not negative for every light")
    padded_scale = np.zeros(lights, dtype=np.float32)
    padded_scale[:count] = scale[:count]
    return Lights(np.pad(direction, extra), np.pad(irradiance, extra), padded_scale)


def channel_weights(lights: Lights, grey_weights: tuple[float, float, float]) -> np.ndarray:
    """Return the grey weights of the channels that every light reaches, summing to 1: readings of differently coloured lights compare.

    Returns:
        [3] float64.

    Raises:
        ArrayError: no channel is lit by every light.
    """
    real = lights.irradiance.any(axis=1)
    common = (lights.irradiance[real] > 0).all(axis=0) & (np.array(grey_weights) > 0)
    if not common.any():
        raise ArrayError("no channel is lit by every light: grey readings of red, green and blue lights do not compare")
    weights = np.where(common, grey_weights, 0)
    return weights / weights.sum()


def grey_factors(lights: Lights, grey_weights: tuple[float, float, float]) -> np.ndarray:
    """Return the factor of each stored channel in the grey reading, with channel_weights.

    Returns:
        [lights, 3] float32; 0 for padding.

    Raises:
        ArrayError: no channel is lit by every light.
    """
    weights = channel_weights(lights, grey_weights)
    real = lights.irradiance.any(axis=1)
    factors = np.zeros_like(lights.irradiance)
    factors[real] = np.divide(weights, lights.irradiance[real], out=np.zeros_like(factors[real]), where=weights > 0)
    return factors * lights.scale[:, None]


class Readings(NamedTuple):
    """Grey readings of a band, one pack after another on the CPU (a pack's lights stay in the first-level cache), one light
    after another on CUDA (neighbouring threads read neighbouring packs): element (pack p, light l) is at
    p · pack_stride + l · light_stride."""

    values: wp.array  # [packs · lights] float packs
    pack_stride: int
    light_stride: int

    def on_host(self, packs: wp.array, pixel_count: int) -> np.ndarray:
        """Return values that lie as these readings do, [..., packs · lights] float packs, as [..., lights, pixels] float32. Waits for the
        device."""
        values = to_numpy(packs)
        *rows, count, width = values.shape
        lights = self.pack_stride if self.light_stride == 1 else count // self.light_stride
        if self.light_stride == 1:
            values = np.moveaxis(values.reshape(*rows, count // lights, lights, width), -2, -3)
        return np.ascontiguousarray(values.reshape(*rows, lights, -1)[..., :pixel_count])


def grey_readings(band: Band, factors: np.ndarray) -> Readings:
    """Compute the grey readings of a band.

    Args:
        factors: [lights, 3], of grey_factors.

    Raises:
        ArrayError: the band has other lights or channels, or is too large to index.
    """
    band.require_channels(3)
    if factors.shape != (band.frame_count, 3):
        raise ArrayError(f"factors are {factors.shape}, the band has {band.frame_count} lights")
    pack = devices.pack_width(band.device)
    packs, lights = band.packs, band.frame_count
    if packs * lights > devices.MAX_THREADS:
        raise ArrayError(f"the band has {packs} packs of {lights} lights: cut it so that their product stays below 2**31")
    values = new_array(packs * lights, pack_type(pack, wp.float32), band.device, cleared=False)
    readings = Readings(values, *((lights, 1) if band.device == "cpu" or packs == 1 else (1, packs)))
    chunk = CHUNK if band.device == "cpu" else 1
    devices.launch(_grey_kernel(pack), -(-packs // chunk),
                   [band.values, band.saturated, wp.array(factors, dtype=wp.float32, device=band.device),
                    readings.pack_stride, readings.light_stride, chunk], [values], device=band.device)
    return readings


@once
def _grey_kernel(pack: int) -> Any:
    half_pack, byte_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.uint8), pack_type(pack, wp.float32)
    load, load_byte, store = pack_load(pack, wp.float16), pack_load(pack, wp.uint8), pack_store(pack, wp.float32, 1)

    @wp.kernel(enable_backward=False, module="unique")
    def grey_kernel(first: int,
                    values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                    saturated: wp.array2d(dtype=byte_pack),  # [L / 8, P] bits
                    factors: wp.array2d(dtype=float),  # [L, 3]
                    pack_stride: int,
                    light_stride: int,
                    chunk: int,  # packs of a thread
                    # outputs
                    readings: wp.array(dtype=float_pack)):
        begin = (first + wp.tid()) * chunk
        end = wp.min(begin + chunk, values.shape[1])
        lights = factors.shape[0]
        for light in range(lights):
            shift = light % 8
            fr, fg, fb = factors[light, 0], factors[light, 1], factors[light, 2]
            for p in range(begin, end):
                red = load(values, light, p)
                green = load(values, lights + light, p)
                blue = load(values, 2 * lights + light, p)
                bits = load_byte(saturated, light / 8, p)
                grey = float_pack()
                for k in range(pack):
                    value = fr * float(red[k]) + fg * float(green[k]) + fb * float(blue[k])
                    cut = (int(bits[k]) >> shift) & 1
                    measured = wp.where(value < LARGEST, wp.max(value, 0.0), 0.0)  # 0 also for NaN
                    grey[k] = wp.where(cut == 0, measured, 0.0)
                store(readings, p * pack_stride + light * light_stride, grey)

    return grey_kernel
