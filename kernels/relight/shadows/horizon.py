"""The horizon of every pixel over the solved height: how high above the picture's plane a far light must stand to be seen.

kernels.relight.shadows.occlusion follows the line to each light. Where many lights are looked for, in many frames, the surface is followed
once in each of a few directions in the picture, and the highest elevation of what is met there is kept; a light is seen if it stands above
the horizon of its direction, interpolated between the two neighbouring ones.

The line from a pixel to a far light runs in the plane of the line of sight and of the light; this plane meets the picture in a
straight line from the pixel. With w = (x/z, y/z, 1) for a perspective camera and (0, 0, 1) for an orthographic one, a direction d
is a horizontal part (dx, dy) - dz · (wx, wy), which points along that line, and dz · w; elevation is the angle whose tangent is dz over
the length of the horizontal part.

Source: Max, "Horizon mapping: shadows for bump-mapped surfaces", The Visual Computer 4, 1988.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.relight.model.shading import Surface
from kernels.surface.shadows import FIRST_STEP, MARGIN_PIXELS, MARGIN_SLOPE, Projection, between_pixels, extent_of

AZIMUTHS = 360
"""Number of directions in the picture in which horizons are found, 1° apart."""
BLOCK = 8
"""Side of the squares of pixels whose greatest height is kept, so that those that stay below the horizon are passed in one step."""
NOTHING = -1.0e9
"""Height outside the surface, and slope where nothing stands in the way."""
ROUNDING = 1e-3
"""Part of the angle between two directions: far more than azimuths in float32 are off."""
LEEWAY = 0.05
"""Margin, absolute and relative, by which horizons are told apart beyond the slopes of the lights: where the horizon of one direction hides
a light and that of the next does not, the edge of the shadow lies between them by their difference."""
STEEPEST = 1e4
"""Largest slope of a light, which then stands along the line of sight."""
TURNED_AWAY = -0.05
"""Cotangent to a light below which a pixel's horizon is not looked for. Between two directions, 1° apart, it changes by 0.02 at most."""
MISSING = -1
"""Row of a direction whose horizon is not computed."""


class Azimuths(NamedTuple):
    """Directions in the picture in which far lights stand, and the range of slopes at which they do."""

    index: np.ndarray  # [rows] ascending; index a is the angle a · 2π / AZIMUTHS from +x towards +y
    low: np.ndarray  # [rows] slopes: tangents of the elevation
    high: np.ndarray  # [rows]


class HeightField(NamedTuple):
    """A solved height on a device, for finding horizons."""

    height: wp.array  # [rows, cols] float32, camera-frame z; NOTHING outside the surface
    greatest: wp.array  # [rows / BLOCK, cols / BLOCK] float32: of each block and the pixels right of it and below
    projection: Projection
    box: wp.vec4i
    """First row and column of the mask, and the last of each, as in kernels.surface.shadows.Extent."""


class Horizons(NamedTuple):
    """Horizons of some pixels in some directions in the picture; on CUDA not synchronised."""

    tangent: wp.array  # [rows, P] half packs: tangent of half the elevation of the horizon, which half resolves alike at any elevation
    row: wp.array  # [AZIMUTHS] int32: which row a direction has; MISSING: it was not asked for
    perspective: bool


def azimuths_of(direction: np.ndarray, sight: np.ndarray) -> Azimuths:
    """Return the directions in the picture between which far lights stand as some pixels see them, and how high they stand there.

    Args:
        direction: [n, 3] unit vectors to the lights.
        sight: [m, 2] (wx, wy) of the pixels; all zero for an orthographic camera.
    """
    low, high = sight.min(axis=0), sight.max(axis=0)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    flat = direction[:, None, :2] - direction[:, None, 2:] * corners  # [n, 4, 2]
    middle = flat.mean(axis=1)
    along = (middle[:, None] * flat).sum(axis=2)
    turned = np.abs(np.arctan2(middle[:, None, 0] * flat[..., 1] - middle[:, None, 1] * flat[..., 0], along)).max(axis=1)
    everywhere = along.min(axis=1) <= 0  # behind some pixels in any direction
    around = np.arctan2(middle[:, 1], middle[:, 0])
    nearest = np.clip(0, flat.min(axis=1), flat.max(axis=1))  # of the box of all horizontal parts to the line of sight
    lengths = np.stack([np.linalg.norm(nearest, axis=1), np.linalg.norm(flat, axis=2).max(axis=1)], axis=1)
    slopes = direction[:, 2:] / np.maximum(lengths, 1 / STEEPEST)
    step = 2 * math.pi / AZIMUTHS
    least, most = np.full(AZIMUTHS, np.inf), np.full(AZIMUTHS, -np.inf)
    for middle_angle, reach, slope in zip(around, np.where(everywhere, math.pi, turned), slopes, strict=True):
        first = math.floor((middle_angle - reach) / step - ROUNDING)
        last = math.floor((middle_angle + reach) / step + ROUNDING) + 1
        at = np.arange(first, min(last, first + AZIMUTHS - 1) + 1) % AZIMUTHS
        least[at], most[at] = np.minimum(least[at], slope.min()), np.maximum(most[at], slope.max())
    index = np.flatnonzero(least <= most)
    least, most = least[index], most[index]
    return Azimuths(index, least - LEEWAY * (1 + np.abs(least)), most + LEEWAY * (1 + np.abs(most)))


def height_field(height: np.ndarray, mask: np.ndarray, projection: Projection, device: str) -> HeightField:
    """Put a height on the device.

    Args:
        height: [rows, cols] camera-frame z.
        mask: [rows, cols] bool: where there is surface. It must be one part: no break of the height is looked for.
        projection: of the camera; the unit is that of height.
    """
    solid = np.where(mask, height, NOTHING).astype(np.float32)
    rows, cols = solid.shape
    padded = np.full((-(-rows // BLOCK) * BLOCK + 1, -(-cols // BLOCK) * BLOCK + 1), NOTHING, dtype=np.float32)
    padded[:rows, :cols] = solid
    reached = np.maximum(np.maximum(padded[:-1, :-1], padded[1:, :-1]), np.maximum(padded[:-1, 1:], padded[1:, 1:]))
    greatest = reached.reshape(len(reached) // BLOCK, BLOCK, -1, BLOCK).max(axis=(1, 3))
    return HeightField(wp.array(solid, dtype=wp.float32, device=device), wp.array(greatest, dtype=wp.float32, device=device), projection,
                       extent_of(solid, mask).box)


def find_horizons(azimuths: Azimuths, pixels: np.ndarray, surface: Surface, field: HeightField) -> Horizons:
    """Find the horizons of pixels as far as lights are hidden by them, by following the surface in some directions in the picture.

    `pixels` are [m] row-major positions in the image, of the same pixels as the surface.

    Convention:
        With an orthographic camera, a light in one of these directions is above the horizon where kernels.relight.shadows.occlusion sees
        it. The horizon of a pixel that is turned away from the lights of a direction is not found, and hides none.
    """
    device = surface.device
    pack, count = devices.pack_width(device), len(azimuths.index)
    where = pixels[np.minimum(np.arange(surface.packs * pack), len(pixels) - 1)]
    angle = azimuths.index * (2 * np.pi / AZIMUTHS)
    towards = np.stack([np.cos(angle), np.sin(angle), azimuths.low, azimuths.high], axis=1)
    tangent = wp.empty((count, surface.packs), dtype=pack_type(pack, wp.float16), device=device)
    row = np.full(AZIMUTHS, MISSING, dtype=np.int32)
    row[azimuths.index] = np.arange(count)
    devices.launch(_horizon_kernel(pack), count * surface.packs,
                   [wp.array(towards, dtype=wp.vec4, device=device), wp.array(where, dtype=wp.int32, device=device), surface.values,
                    field.height, field.greatest, field.projection.perspective, field.projection.scale, field.box], [tangent],
                   device=device, uneven=True)
    return Horizons(tangent, wp.array(row, dtype=wp.int32, device=device), field.projection.perspective)


@wp.func
def _stands(met: float, floor: float, perspective: bool, per_pixel: float) -> float:
    """Return how high surface of height `met` stands above a floor, in pixels as far away as it is."""
    high = (met - floor) * per_pixel
    if perspective:
        high = high / -met
    return high


@wp.func
def _until(place: float, step: float, block: int) -> float:
    """Return after how many steps a coordinate leaves a block."""
    edge = float(block * BLOCK) + wp.where(step > 0.0, wp.static(float(BLOCK)), 0.0)
    return wp.where(wp.abs(step) > 1.0e-6, (edge - place) / step, 1.0e6)


def see_above(direction: np.ndarray, surface: Surface, horizons: Horizons) -> wp.array:
    """Return which pixels see which far lights, between directions whose horizons are there, as occlusion.see_lights does."""
    if horizons.tangent.shape[1] != surface.packs:
        raise ArrayError(f"horizons have {horizons.tangent.shape[1]} packs, the surface {surface.packs}: give the same pixels")
    pack = devices.pack_width(surface.device)
    visible = wp.empty((len(direction), surface.packs), dtype=pack_type(pack, wp.uint8), device=surface.device)
    devices.launch(_above_kernel(pack), len(direction) * surface.packs,
                   [wp.array(direction, dtype=wp.vec3, device=surface.device), surface.values, horizons.tangent, horizons.row,
                    horizons.perspective], [visible], device=surface.device)
    return visible


@once
def _horizon_kernel(pack: int) -> Any:
    lane_type, half_pack = pack_type(pack, wp.float32), pack_type(pack, wp.float16)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def horizon_kernel(first: int,
                       azimuths: wp.array(dtype=wp.vec4),  # [N] unit vector in the picture, y up; lowest and highest slope of lights
                       pixels: wp.array(dtype=wp.int32),  # [P · pack]
                       values: wp.array2d(dtype=lane_type),  # [24, P] of the surface
                       height: wp.array2d(dtype=float),
                       greatest: wp.array2d(dtype=float),
                       perspective: bool,
                       scale: wp.vec2,
                       box: wp.vec4i,
                       # outputs
                       tangent: wp.array2d(dtype=half_pack)):  # [N, P]
        thread = first + wp.tid()
        packs = tangent.shape[1]
        azimuth = thread / packs
        p = thread % packs
        per_pixel = 0.5 * (scale[0] + scale[1])
        towards = azimuths[azimuth]
        high = towards[3] + MARGIN_SLOPE
        du = towards[0] * scale[0] / per_pixel
        dv = -towards[1] * scale[1] / per_pixel
        low_row, low_col = wp.max(box[0] - 1, 0), wp.max(box[1] - 1, 0)
        high_row, high_col = wp.min(box[2], height.shape[0] - 2), wp.min(box[3], height.shape[1] - 2)
        nx = values[0, p]
        ny = values[1, p]
        nz = values[2, p]
        px = values[12, p]
        py = values[13, p]
        pz = values[14, p]
        facing = lane_type()
        for k in range(pack):
            flat = nx[k] * towards[0] + ny[k] * towards[1]
            rise = nz[k]
            if perspective:
                rise += (nx[k] * px[k] + ny[k] * py[k]) / pz[k]
            facing[k] = wp.max((flat + towards[2] * rise) / wp.sqrt(1.0 + towards[2] * towards[2]),
                               (flat + towards[3] * rise) / wp.sqrt(1.0 + towards[3] * towards[3]))
        out = half_pack()
        for k in range(pack):
            n = pixels[p * pack + k]
            row, col = n / height.shape[1], n % height.shape[1]
            z = height[row, col]
            own = wp.where(perspective, -z, 1.0) / per_pixel  # what a pixel spans here
            floor = z + MARGIN_PIXELS * own
            best = towards[2] + MARGIN_SLOPE
            travelled = float(FIRST_STEP)
            for _ in range(wp.where(facing[k] > TURNED_AWAY, height.shape[0] + height.shape[1], 0)):
                u, v = float(col) + travelled * du, float(row) + travelled * dv
                c, r = int(wp.floor(u)), int(wp.floor(v))
                if c < low_col or r < low_row or c > high_col or r > high_row or best > high:
                    break
                most = greatest[r / BLOCK, c / BLOCK]
                farthest = travelled + wp.where(most > floor, 0.0, wp.static(2.0 * BLOCK))  # where the block looks highest from here
                if _stands(most, floor, perspective, per_pixel) > best * farthest:
                    stands = _stands(between_pixels(height, u, v), floor, perspective, per_pixel)
                    if stands > best * travelled:
                        best = stands / travelled
                    travelled += 1.0
                else:
                    travelled += wp.max(1.0, wp.ceil(wp.min(_until(u, du, c / BLOCK), _until(v, dv, r / BLOCK))))
            best = wp.min(best, high) - MARGIN_SLOPE
            out[k] = wp.float16(_half_tangent(best, 1.0))
        tangent[azimuth, p] = out

    return horizon_kernel


@once
def _above_kernel(pack: int) -> Any:
    lane_type, half_pack, byte_pack = (pack_type(pack, dtype) for dtype in (wp.float32, wp.float16, wp.uint8))

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def above_kernel(first: int,
                     direction: wp.array(dtype=wp.vec3),  # [N]
                     values: wp.array2d(dtype=lane_type),  # [24, P] of a surface
                     tangent: wp.array2d(dtype=half_pack),  # [rows, P]
                     row: wp.array(dtype=wp.int32),  # [AZIMUTHS]
                     perspective: bool,
                     # outputs
                     visible: wp.array2d(dtype=byte_pack)):  # [N, P]
        thread = first + wp.tid()
        packs = visible.shape[1]
        n = thread / packs
        p = thread % packs
        light = direction[n]
        out = byte_pack()
        if perspective:
            px = values[12, p]
            py = values[13, p]
            pz = values[14, p]
            for k in range(pack):
                flat = wp.vec2(light[0] - light[2] * px[k] / pz[k], light[1] - light[2] * py[k] / pz[k])
                rows = _rows(flat, row)
                below = tangent[int(rows[0]), p]
                over = tangent[int(rows[1]), p]
                horizon = float(below[k]) + rows[2] * (float(over[k]) - float(below[k]))
                out[k] = wp.where(_half_tangent(light[2], wp.length(flat)) >= horizon, wp.uint8(255), wp.uint8(0))
        else:
            flat = wp.vec2(light[0], light[1])
            rows = _rows(flat, row)
            high = _half_tangent(light[2], wp.length(flat))
            below = tangent[int(rows[0]), p]
            over = tangent[int(rows[1]), p]
            for k in range(pack):
                horizon = float(below[k]) + rows[2] * (float(over[k]) - float(below[k]))
                out[k] = wp.where(high >= horizon, wp.uint8(255), wp.uint8(0))
        visible[n, p] = out

    return above_kernel


@wp.func
def _rows(flat: wp.vec2, row: wp.array(dtype=wp.int32)) -> wp.vec3:
    """Return the rows of the two directions around one in the picture, and how far it is from the first to the second."""
    place = wp.atan2(flat[1], flat[0]) * wp.static(AZIMUTHS / (2.0 * math.pi))
    low = wp.floor(place)
    first = (int(low) + AZIMUTHS) % AZIMUTHS
    return wp.vec3(float(row[first]), float(row[(first + 1) % AZIMUTHS]), place - low)


@wp.func
def _half_tangent(rise: float, flat: float) -> float:
    """Return the tangent of half the elevation of a direction."""
    return rise / (flat + wp.sqrt(flat * flat + rise * rise))
