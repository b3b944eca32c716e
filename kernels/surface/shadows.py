"""Cast shadows on a height field: the line from a surface point to a light is marched, that is, followed over the picture pixel by pixel,
and the height of the surface is compared with it.

A point is in shadow when the surface stands above the line by more than a margin: a part of a pixel, and a slope by which a
height integrated from normals may err. Only surface that the camera sees can cast a shadow here. Of another part of the object than the
point's own only the visible front does, and what lies behind it within a guessed thickness, where one is given: the line must pass through
either, and one that stays farther behind from where it comes into the picture of that part to where it leaves passes behind the part.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy

MARGIN_PIXELS = 0.3
"""Height above the marched line, in pixels, that the surface must exceed to hide the light."""
MARGIN_SLOPE = 0.02
"""Growth of that height with the distance from the point, per unit of the picture's plane: integrated heights drift by about a degree."""
FIRST_STEP = 1.5
"""Distance from the point, in pixels, at which the march begins: the point's own neighbours cannot tell cast shadow."""

NO_REACH = 1.0e30
"""Reach of the march to a distant light: a length beyond every scene."""


@wp.struct
class Camera:
    """A projection, as kernels take it."""

    perspective: bool
    scale: wp.vec2
    centre: wp.vec2


class Projection(NamedTuple):
    """The projection of camera-frame points to the picture, without lens distortion."""

    perspective: bool
    scale: wp.vec2  # perspective: focal lengths in pixels; orthographic: pixels per unit
    centre: wp.vec2  # principal point in pixels

    def on_device(self) -> Any:
        """Return the `Camera` of this projection."""
        camera = Camera()
        camera.perspective, camera.scale, camera.centre = self
        return camera


class Extent(NamedTuple):
    """The extent of a surface, beyond which the march to a light meets nothing."""

    box: wp.vec4i  # first row and column of the mask, and the last of each
    highest: float  # camera-frame z


def extent_of(height: np.ndarray, mask: np.ndarray) -> Extent:
    """Return where a surface is: height is camera-frame z, the mask 0 outside the surface."""
    inside = mask != 0
    rows, cols = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return Extent(wp.vec4i(0, 0, -1, -1), -NO_REACH)
    return Extent(wp.vec4i(int(rows[0]), int(cols[0]), int(rows[-1]), int(cols[-1])), float(height[inside].max()))


@wp.struct
class Relief:
    """A surface over which lines to lights are marched."""

    height: wp.array2d(dtype=float)  # [rows, cols] camera-frame z
    mask: wp.array2d(dtype=wp.uint8)  # [rows, cols] 0 outside the surface, elsewhere the number of the part; without breaks it is one part
    camera: Camera
    box: wp.vec4i  # as in Extent
    highest: float
    thickness: wp.array2d(dtype=float)  # [rows, cols] from front to back, as a camera-frame length
    has_backs: bool  # without: only fronts hide light, and there is no thickness


def relief_of(height: wp.array, mask: wp.array, projection: Projection, extent: Extent | None = None,
              thickness: wp.array | None = None) -> Any:
    """Return the `Relief` of a surface on the device; its extent is found where it is not given."""
    relief = Relief()
    relief.has_backs = thickness is not None
    relief.thickness = wp.empty((0, 0), dtype=wp.float32, device=height.device) if thickness is None else thickness
    relief.height, relief.mask, relief.camera = height, mask, projection.on_device()
    relief.box, relief.highest = extent or extent_of(to_numpy(height), to_numpy(mask))
    return relief


@wp.func
def project(point: wp.vec3, camera: Camera) -> wp.vec2:
    """Return the continuous image coordinates of a camera-frame point."""
    far = wp.where(camera.perspective, wp.max(-point[2], 1.0e-9), 1.0)
    return wp.vec2(camera.centre[0] + camera.scale[0] * point[0] / far, camera.centre[1] - camera.scale[1] * point[1] / far)


@wp.func
def surface_point(row: int, col: int, height: wp.array2d(dtype=float), camera: Camera) -> wp.vec3:
    """Return the camera-frame point of the surface in the middle of a pixel."""
    z = height[row, col]
    far = wp.where(camera.perspective, -z, 1.0)
    return wp.vec3((float(col) + 0.5 - camera.centre[0]) / camera.scale[0] * far,
                   (camera.centre[1] - (float(row) + 0.5)) / camera.scale[1] * far, z)


@wp.func
def pixel_span(z: float, camera: Camera) -> float:
    """Return what a pixel spans at a camera-frame z."""
    return wp.where(camera.perspective, -z, 1.0) / (0.5 * (camera.scale[0] + camera.scale[1]))


@wp.func
def between_pixels(height: wp.array2d(dtype=float), u: float, v: float) -> float:
    """Return the height between the four pixels around (u, v), bilinear; pixel (row r, column c) is at (c, r)."""
    c, r = int(wp.floor(u)), int(wp.floor(v))
    fu, fv = u - float(c), v - float(r)
    upper = height[r, c] * (1.0 - fu) + height[r, c + 1] * fu
    lower = height[r + 1, c] * (1.0 - fu) + height[r + 1, c + 1] * fu
    return upper * (1.0 - fv) + lower * fv


@wp.func
def in_shadow_within(relief: Relief, row: int, col: int, toward: wp.vec3, reach: float) -> bool:
    """Return whether the surface hides a light in this direction from this pixel before `reach`: what lies behind a light hides nothing.

    The march ends where it leaves the box of the surface, or rises above its highest point other than from behind a part.
    """
    start = surface_point(row, col, relief.height, relief.camera)
    pixel = pixel_span(start[2], relief.camera)
    across = wp.sqrt(toward[0] * toward[0] + toward[1] * toward[1])
    if across < 1.0e-4:
        return False  # along the line of sight
    stride = pixel / across
    travelled = FIRST_STEP * stride
    hidden, behind = bool(False), bool(False)  # literals could not change inside the loop
    box = relief.box
    own = int(relief.mask[row, col])
    last = own  # the part that the line met last; `behind`, whether it ran behind that part's front
    for _ in range(relief.mask.shape[0] + relief.mask.shape[1]):
        if travelled >= reach:
            break
        point = start + travelled * toward
        if point[2] > relief.highest and toward[2] >= 0.0 and not behind:
            break
        at = project(point, relief.camera)
        u, v = at[0] - 0.5, at[1] - 0.5
        c, r = int(wp.floor(u)), int(wp.floor(v))
        if c < box[1] - 1 or r < box[0] - 1 or c > box[3] or r > box[2]:
            break
        if c < 0 or r < 0 or c >= relief.mask.shape[1] - 1 or r >= relief.mask.shape[0] - 1:
            break
        part = int(relief.mask[r, c])
        if (part != 0 and int(relief.mask[r, c + 1]) == part and int(relief.mask[r + 1, c]) == part
                and int(relief.mask[r + 1, c + 1]) == part):
            above = between_pixels(relief.height, u, v) - point[2]
            under = above > MARGIN_PIXELS * pixel + MARGIN_SLOPE * travelled * across
            hidden = under
            if part != own:
                hidden = part == last and under != behind
                if relief.has_backs:
                    hidden = hidden or (under and above < relief.thickness[r, c])
            last, behind = part, under
            if hidden:
                break
        travelled += stride
    return hidden
