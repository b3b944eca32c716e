"""Readings of chosen pixels, gathered for solvers that take long for each pixel: pixels outside the mask cost nothing."""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once, to_numpy
from kernels.errors import ArrayError
from kernels.packs import Band, as_pixels, pack_type
from kernels.photometric.lambertian.near import NearField, falloff, near_direction
from kernels.photometric.lambertian.readings import LARGEST, Lights

SHADOW_FRACTION = 0.1
"""Fraction of the level of all readings below which a reading counts as shadow and is left out of the pixel's level."""


class Samples(NamedTuple):
    """Readings of chosen pixels; element (pack p, light l) of an array is at p · pack_stride + l · light_stride.

    The last pack repeats its last pixel.
    """

    grey: wp.array  # [packs · lights] float packs: grey reading / level; below 0 where there is no reading
    colour: wp.array  # [3, packs · lights] float packs: radiance / irradiance; below 0 where there is no reading
    level: wp.array  # [packs] float packs: how bright the lit readings of the pixel are, grey
    toward: wp.array  # [3, packs · lights] float packs: unit direction from the surface to the light
    view: wp.array  # [3, packs] float packs: unit direction to the viewer
    pixel_count: int
    packs: int
    light_count: int
    lanes: int
    pack_stride: int
    light_stride: int
    device: str

    @property
    def arrays(self) -> Any:
        """The samples in the form that kernels take: an instance of `samples_type`."""
        arrays = samples_type(self.lanes)()
        for name in arrays._cls.vars:
            setattr(arrays, name, getattr(self, name))
        return arrays


@once
def samples_type(lanes: int) -> Any:
    """Return the Warp struct of samples in packs of this width; its fields are those of `Samples`."""
    lane_type = pack_type(lanes, wp.float32)

    @wp.struct
    class PackedSamples:
        grey: wp.array(dtype=lane_type)
        colour: wp.array2d(dtype=lane_type)
        level: wp.array(dtype=lane_type)
        toward: wp.array2d(dtype=lane_type)
        view: wp.array2d(dtype=lane_type)
        light_count: int
        pack_stride: int
        light_stride: int

    return PackedSamples


@once
def scratch_type(lanes: int) -> Any:
    """Return the Warp struct of scratch memory: value v of light l of pack p is at p · pack_stride + l · light_stride + v · step."""
    lane_type = pack_type(lanes, wp.float32)

    @wp.struct
    class Scratch:
        values: wp.array(dtype=lane_type)
        pack_stride: int
        light_stride: int
        step: int

    return Scratch


def evenly(count: int, most: int) -> np.ndarray:
    """Return indices at even steps from 0 to count - 1: all of them, or `most`, one or more, where there are more."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def some_of(mask: np.ndarray, most: int) -> np.ndarray:
    """Return the row-major positions of the pixels of a mask: of all of them, or of `most` at even steps where there are more."""
    inside = np.flatnonzero(mask)
    return np.asarray(inside[evenly(len(inside), most)])


def gather(band: Band, pixels: np.ndarray, view: np.ndarray, lights: Lights, factors: np.ndarray, light_count: int,
           field: NearField | None = None) -> Samples:
    """Gather the readings of some pixels of a band.

    Args:
        pixels: [n] int32 positions in the band, one or more.
        view: [n, 3] unit directions from the surface to the viewer.
        lights: irradiance and scale of each light.
        factors: [lights, 3], of readings.grey_factors.
        light_count: lights without padding.
        field: places of the lights and the points of these pixels, in place of the lights' directions, where some light is near.

    Returns:
        The samples on the device.

    Raises:
        ArrayError: no pixel, positions outside the band, or a view or points for other pixels.
    """
    if len(pixels) == 0 or pixels.min() < 0 or pixels.max() >= band.pixel_count:
        raise ArrayError(f"pixels must be one or more positions from 0 to {band.pixel_count - 1}")
    if view.shape != (len(pixels), 3):
        raise ArrayError(f"view is {view.shape}, expected {(len(pixels), 3)}")
    if field is not None and (field.points.shape != (3, len(pixels)) or len(field.places.place) != len(lights.direction)):
        raise ArrayError(f"points are {field.points.shape} under {len(field.places.place)} padded lights, expected "
                         f"{(3, len(pixels))} under {len(lights.direction)}")
    device = band.device
    lanes = devices.pack_width(device) if device == "cpu" else devices.LANES_CUDA
    packs = -(-len(pixels) // lanes)
    padding = packs * lanes - len(pixels)
    pack_stride, light_stride = (light_count, 1) if device == "cpu" else (1, packs)
    lane_type = pack_type(lanes, wp.float32)
    samples = Samples(wp.empty(packs * light_count, dtype=lane_type, device=device),
                      wp.empty((3, packs * light_count), dtype=lane_type, device=device),
                      wp.empty(packs, dtype=lane_type, device=device), wp.empty((3, packs * light_count), dtype=lane_type, device=device),
                      _upload(view, (3, packs), lanes, device), len(pixels), packs, light_count, lanes,
                      pack_stride, light_stride, device)
    per_channel = np.divide(lights.scale[:, None], lights.irradiance, out=np.zeros_like(lights.irradiance),
                            where=lights.irradiance > 0)
    where = wp.array(np.pad(pixels, (0, padding), mode="edge"), dtype=wp.int32, device=device)
    if field is None:
        near = (wp.empty(0, dtype=wp.vec4, device=device),) * 2 + (wp.empty((3, 0), dtype=float, device=device),)
    else:
        near = (wp.array(field.places.place, dtype=wp.vec4, device=device), wp.array(field.places.lobe, dtype=wp.vec4, device=device),
                wp.array(np.pad(field.points, ((0, 0), (0, padding)), mode="edge"), dtype=float, device=device))
    devices.launch(_gather_kernel(lanes, field is not None), packs,
                   [as_pixels(band.values), as_pixels(band.saturated), where, wp.array(factors, dtype=wp.vec3, device=device),
                    wp.array(per_channel, dtype=wp.vec3, device=device), wp.array(lights.direction, dtype=wp.vec3, device=device),
                    *near], [samples.arrays], device=device)
    return samples


def per_pixel(samples: Samples, values: np.ndarray) -> wp.array:
    """Return [n, k] host values of the sampled pixels as [k, packs] packs on the device."""
    return _upload(values, (values.shape[1], samples.packs), samples.lanes, samples.device)


def _upload(values: np.ndarray, shape: tuple[int, int], lanes: int, device: str) -> wp.array:
    """Return host values [n, k] as [k, packs] packs on the device, whose last pixel fills the last pack."""
    planes, count = np.empty((shape[0], shape[1] * lanes), dtype=np.float32), len(values)
    planes[:, :count] = values.T
    planes[:, count:] = planes[:, count - 1 : count]
    return _as_packs(planes, shape, lanes, device)


def _as_packs(values: np.ndarray, shape: tuple[int, ...], lanes: int, device: str) -> wp.array:
    """Return host values as packs of this shape on the device; without a shape, Warp drops axes of length one before packs of one."""
    return wp.array(np.ascontiguousarray(values), shape=shape, dtype=pack_type(lanes, wp.float32), device=device)


def scratch_memory(samples: Samples, held: int) -> Any:
    """Return memory for some values of each light and sampled pixel, as kernels take it: an instance of `scratch_type`.

    Args:
        samples: the readings beside which the values lie.
        held: values for each light.
    """
    size = samples.light_count * held
    scratch = scratch_type(samples.lanes)()
    scratch.values = wp.empty(samples.packs * size, dtype=pack_type(samples.lanes, wp.float32), device=samples.device)
    scratch.pack_stride, scratch.step = (size, 1) if samples.device == "cpu" else (1, samples.packs)
    scratch.light_stride = held * scratch.step
    return scratch


def to_host(samples: Samples, packs: wp.array) -> np.ndarray:
    """Return [k, packs] or [packs] packs as [n, k] or [n] host values; waits for the device."""
    values = to_numpy(packs)
    flat = values.reshape(*values.shape[:-2], -1) if values.ndim > 1 else values
    flat = flat.reshape(-1, samples.packs * samples.lanes)[:, : samples.pixel_count]
    return flat[0] if packs.ndim == 1 else flat.T


def host_values(samples: Samples, packs: wp.array) -> np.ndarray:
    """Return [packs · lights] packs on the device as [n, lights] host values; waits for the device."""
    values = to_numpy(packs)
    if samples.light_stride == 1:
        flat = values.reshape(samples.packs, samples.light_count, samples.lanes).transpose(0, 2, 1)
    else:
        flat = values.reshape(samples.light_count, samples.packs, samples.lanes).transpose(1, 2, 0)
    return flat.reshape(-1, samples.light_count)[: samples.pixel_count]


def host_vectors(samples: Samples, planes: wp.array) -> np.ndarray:
    """Return [3, packs · lights] packs on the device, colours or directions, as [3, n, lights] host values; waits for the device."""
    return np.stack([host_values(samples, planes[c]) for c in range(3)])


def device_values(samples: Samples, values: np.ndarray) -> wp.array:
    """Return [n, lights] host values as [packs · lights] packs on the device."""
    order = np.minimum(np.arange(samples.packs * samples.lanes), samples.pixel_count - 1)
    planes = values[order].astype(np.float32).reshape(samples.packs, samples.lanes, samples.light_count)
    planes = planes.transpose(0, 2, 1) if samples.light_stride == 1 else planes.transpose(2, 0, 1)
    return _as_packs(planes, samples.grey.shape, samples.lanes, samples.device)


def readings_of(samples: Samples) -> np.ndarray:
    """Return [n, lights] grey readings radiance over irradiance; below 0 where there is none; waits for the device."""
    return np.asfortranarray(host_values(samples, samples.grey) * to_host(samples, samples.level)[:, None])


@once
def _gather_kernel(lanes: int, near: bool = False) -> Any:
    lane_type, samples_struct = pack_type(lanes, wp.float32), samples_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def gather_kernel(first: int,
                      values: wp.array2d(dtype=wp.float16),  # [3 · L padded, N] stored radiance
                      saturated: wp.array2d(dtype=wp.uint8),  # [L / 8, N] bits
                      pixels: wp.array(dtype=wp.int32),  # [P · lanes]
                      grey_factors: wp.array(dtype=wp.vec3),  # [L padded]
                      channel_factors: wp.array(dtype=wp.vec3),  # [L padded]
                      directions: wp.array(dtype=wp.vec3),  # [L padded]
                      places: wp.array(dtype=wp.vec4),  # [L padded], if near in place of directions
                      lobes: wp.array(dtype=wp.vec4),  # [L padded], if near
                      points: wp.array2d(dtype=float),  # [3, P · lanes], if near
                      # outputs
                      samples: samples_struct):  # its view is given
        p = first + wp.tid()
        padded = grey_factors.shape[0]
        root, given = lane_type(), lane_type()
        for light in range(samples.light_count):
            at = p * samples.pack_stride + light * samples.light_stride
            f, g, way = grey_factors[light], channel_factors[light], directions[light]
            inverse = lane_type()  # 1 / falloff
            if wp.static(near):
                place = places[light]
                tx, ty, tz = lane_type(), lane_type(), lane_type()
                for k in range(lanes):
                    m = p * lanes + k
                    near_way = near_direction(place, points[0, m], points[1, m], points[2, m])
                    tx[k] = near_way[0]
                    ty[k] = near_way[1]
                    tz[k] = near_way[2]
                    fall = falloff(place, lobes[light], points[0, m], points[1, m], points[2, m])
                    inverse[k] = wp.where(fall > 0.0, 1.0 / wp.max(fall, 1.0e-30), 0.0)
                samples.toward[0, at] = tx
                samples.toward[1, at] = ty
                samples.toward[2, at] = tz
            else:
                for c in range(3):
                    same = lane_type()
                    for k in range(lanes):
                        same[k] = way[c]
                    samples.toward[c, at] = same
            y, red, green, blue = lane_type(), lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                n = pixels[p * lanes + k]
                r = float(values[light, n])
                gr = float(values[padded + light, n])
                b = float(values[2 * padded + light, n])
                if wp.static(near):
                    r = r * inverse[k]
                    gr = gr * inverse[k]
                    b = b * inverse[k]
                sound = wp.where((int(saturated[light / 8, n]) >> (light % 8)) & 1 == 0, 1, 0)
                value = f[0] * r + f[1] * gr + f[2] * b
                sound = wp.where(value < LARGEST, sound, 0)  # 0 also for NaN
                if wp.static(near):
                    sound = wp.where(inverse[k] > 0.0, sound, 0)
                y[k] = wp.where(sound == 1, wp.max(value, 0.0), -1.0)
                red[k] = wp.where(sound == 1, wp.max(g[0] * r, 0.0), -1.0)
                green[k] = wp.where(sound == 1, wp.max(g[1] * gr, 0.0), -1.0)
                blue[k] = wp.where(sound == 1, wp.max(g[2] * b, 0.0), -1.0)
                root[k] += wp.where(value > 0.0, wp.sqrt(wp.max(y[k], 0.0)), 0.0)
                given[k] += wp.where(y[k] > 0.0, 1.0, 0.0)
            samples.grey[at] = y
            samples.colour[0, at] = red
            samples.colour[1, at] = green
            samples.colour[2, at] = blue
        # the level: mean root of the lit readings, squared; highlights hardly move it
        first_level, lit_root, lit = lane_type(), lane_type(), lane_type()
        for k in range(lanes):
            mean = root[k] / wp.max(given[k], 1.0)
            first_level[k] = mean * mean
        for light in range(samples.light_count):
            y = samples.grey[p * samples.pack_stride + light * samples.light_stride]
            for k in range(lanes):
                shines = wp.where(y[k] > SHADOW_FRACTION * first_level[k], 1.0, 0.0)
                lit[k] += shines
                lit_root[k] += shines * wp.sqrt(wp.max(y[k], 0.0))
        scale = lane_type()
        for k in range(lanes):
            mean = lit_root[k] / wp.max(lit[k], 1.0)
            scale[k] = wp.max(mean * mean, 1.0e-20)
        samples.level[p] = scale
        for light in range(samples.light_count):
            at = p * samples.pack_stride + light * samples.light_stride
            y = samples.grey[at]
            relative = lane_type()
            for k in range(lanes):
                relative[k] = wp.where(y[k] >= 0.0, y[k] / scale[k], -1.0)
            samples.grey[at] = relative

    return gather_kernel
