"""Lights at finite distance: every pixel sees a point light from its own direction and distance.

A light is a homogeneous point (x, y, z, w): the way from a surface point p to it is xyz - w p. With w = 1 it is a point light at
xyz, with w = 0 a distant light in direction xyz, so that one kernel takes both. At normal incidence the irradiance is the light's
strength times its falloff: cos^μ/d² for a point light, 1 for a distant one. A reading divided by the falloff is b·l again.

Source: Quéau, Durix, Wu, Cremers, Lauze and Durou, "LED-based photometric stereo: modeling, calibration and numerical solution", JMIV 2018
(point lights of anisotropy μ).
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import Band, pack_type, vector_at
from kernels.photometric.lambertian.readings import Readings

LEAST_LOBE = 0.01
"""Least radiation towards a point, relative to that along the light's axis, at which the light gives a reading: less would amplify the
noise a hundredfold."""


class Places(NamedTuple):
    """Positions of the lights of a stack, padded as its light axis is."""

    place: np.ndarray  # [lights, 4] float32: position and 1, or unit direction from the surface and 0; padding is 0
    lobe: np.ndarray  # [lights, 4] float32: unit axis from the light and exponent μ; μ = 0: the same all round


class NearField(NamedTuple):
    """Positions of the lights, and the surface points that they light."""

    places: Places
    points: np.ndarray  # [3, pixels] float32, camera frame, in the unit of the places; finite at every pixel

    def at(self, pixels: np.ndarray) -> "NearField":
        """Return the field of some pixels, [n] positions; a position past the end, as padding has, is the last pixel."""
        return NearField(self.places, self.points[:, np.minimum(pixels, self.points.shape[1] - 1)])


class NearLights(NamedTuple):
    """Direction and falloff of every light at every pixel of a band; elements lie as in its readings."""

    toward: wp.array  # [3, packs · lights] float packs: unit direction from the surface to the light
    falloff: wp.array  # [packs · lights] float packs: irradiance at normal incidence / strength; 0 where it hardly shines


def pad_places(place: np.ndarray, lobe: np.ndarray) -> Places:
    """Check places and pad them to a multiple of 8.
    `place`: [n, 4] positions (w = 1) and unit directions (w = 0). `lobe`: [n, 4] unit axes and exponents, 0 for none. Raises ArrayError:
    shapes that do not fit, numbers that are not finite, a w other than 0 and 1, an exponent below 0."""
    place, lobe = np.asarray(place, dtype=np.float32), np.asarray(lobe, dtype=np.float32)
    count = len(place)
    if place.shape != (count, 4) or lobe.shape != (count, 4) or count == 0:
        raise ArrayError(f"place is {place.shape}, lobe {lobe.shape}: give one row of four per light")
    if not (np.isfinite(place).all() and np.isfinite(lobe).all()):
        raise ArrayError("place and lobe must be finite")
    if not np.isin(place[:, 3], (0, 1)).all() or (lobe[:, 3] < 0).any():
        raise ArrayError("place ends in 1 for a point light and 0 for a distant one, and an exponent is 0 or above")
    extra = ((0, -count % 8), (0, 0))
    return Places(np.pad(place, extra), np.pad(lobe, extra))


def see_near(band: Band, readings: Readings, field: NearField) -> NearLights:
    """Find the direction and falloff of every light at every pixel, and divide the readings by the falloff; not synchronised on CUDA.
    `readings`: radiance / strength, of readings.grey_readings; on return b·l, or 0 where the light hardly shines. `field`: places of the
    band's lights, and the points of its pixels."""
    places, points = field
    if len(places.place) != band.frame_count or points.shape != (3, band.pixel_count):
        raise ArrayError(f"there are {len(places.place)} padded lights and {points.shape} points, the band has "
                         f"{band.frame_count} lights and {band.pixel_count} pixels")
    device, pack = band.device, devices.pack_width(band.device)
    float_pack = pack_type(pack, wp.float32)
    held = np.pad(np.asarray(points, dtype=np.float32), ((0, 0), (0, -band.pixel_count % pack)), mode="edge")
    lights = NearLights(wp.empty((3, readings.values.shape[0]), dtype=float_pack, device=device),
                        wp.empty(readings.values.shape[0], dtype=float_pack, device=device))
    devices.launch(_near_kernel(pack), band.packs,
                   [wp.array(places.place, dtype=wp.vec4, device=device), wp.array(places.lobe, dtype=wp.vec4, device=device),
                    wp.array(held.reshape(3, -1, pack), dtype=float_pack, device=device), readings.pack_stride,
                    readings.light_stride], [readings.values, lights.toward, lights.falloff], device=device)
    return lights


def toward_or_none(near_lights: NearLights | None, device: str) -> wp.array:
    """Return the directions as a kernel takes them: empty for distant lights, whose kernel does not read them."""
    return wp.empty((3, 0), dtype=_float_pack(device), device=device) if near_lights is None else near_lights.toward


def falloff_or_none(near_lights: NearLights | None, device: str) -> wp.array:
    """Return the falloff as a kernel takes it: empty for distant lights."""
    return wp.empty(0, dtype=_float_pack(device), device=device) if near_lights is None else near_lights.falloff


def _float_pack(device: str) -> Any:
    return pack_type(devices.pack_width(device), wp.float32)


@once
def directions_in(pack: int, near: bool) -> tuple[Any, int]:
    """Return the Warp function that gives the directions to a light from the pixels of a pack, as three vectors, and the step from one
    pixel to the next in them: 0 for distant lights, whose direction all pixels share.

    Args:
        near: whether the directions differ from pixel to pixel, and are read from `toward`.
    """
    float_pack, shared = pack_type(pack, wp.float32), pack_type(1, wp.float32)

    @wp.func
    def distant(lights: wp.array(dtype=wp.vec3), toward: wp.array2d(dtype=float_pack), light: int, at: int):
        return shared(lights[light][0]), shared(lights[light][1]), shared(lights[light][2])

    @wp.func
    def finite(lights: wp.array(dtype=wp.vec3), toward: wp.array2d(dtype=float_pack), light: int, at: int):
        return toward[0, at], toward[1, at], toward[2, at]

    return (finite, 1) if near else (distant, 0)


@wp.func
def near_direction(place: wp.vec4, x: float, y: float, z: float) -> wp.vec3:
    """Return the unit direction from the point to a light of either kind; 0 for padding."""
    way = wp.vec3(place[0] - place[3] * x, place[1] - place[3] * y, place[2] - place[3] * z)
    return way / wp.max(wp.length(way), 1.0e-20)


@wp.func
def falloff(place: wp.vec4, lobe: wp.vec4, x: float, y: float, z: float) -> float:
    """Return the irradiance at normal incidence over the light's strength: cos^μ/d², 1 if distant; 0 where the light hardly shines."""
    if place[3] == 0.0:
        return 1.0
    way = wp.vec3(place[0] - x, place[1] - y, place[2] - z)
    squared = wp.max(wp.dot(way, way), 1.0e-20)
    if lobe[3] == 0.0:
        return 1.0 / squared
    cosine = -(lobe[0] * way[0] + lobe[1] * way[1] + lobe[2] * way[2]) / wp.sqrt(squared)
    shining = wp.pow(wp.max(cosine, 0.0), lobe[3])
    return wp.where(shining < LEAST_LOBE, 0.0, shining / squared)


@once
def _near_kernel(pack: int) -> Any:
    float_pack = pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def near_kernel(first: int,
                    places: wp.array(dtype=wp.vec4),  # [L]
                    lobes: wp.array(dtype=wp.vec4),  # [L]
                    points: wp.array2d(dtype=float_pack),  # [3, P]
                    pack_stride: int,
                    light_stride: int,
                    # outputs
                    readings: wp.array(dtype=float_pack),  # [P · L] in: radiance / strength, out: b·l
                    toward: wp.array2d(dtype=float_pack),  # [3, P · L]
                    part: wp.array(dtype=float_pack)):  # [P · L]
        p = first + wp.tid()
        px, py, pz = vector_at(points, p)
        for light in range(places.shape[0]):
            at = p * pack_stride + light * light_stride
            place = places[light]
            lobe = lobes[light]
            y = readings[at]
            tx, ty, tz, fall, divided = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
            for k in range(pack):
                way = near_direction(place, px[k], py[k], pz[k])
                tx[k] = way[0]
                ty[k] = way[1]
                tz[k] = way[2]
                fall[k] = falloff(place, lobe, px[k], py[k], pz[k])
                divided[k] = wp.where(fall[k] > 0.0, y[k] / wp.max(fall[k], 1.0e-30), 0.0)
            toward[0, at] = tx
            toward[1, at] = ty
            toward[2, at] = tz
            part[at] = fall
            readings[at] = divided

    return near_kernel
