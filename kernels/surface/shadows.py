"""Cast shadows on a height field: the line from a surface point to a light is marched, that is, followed over the picture pixel by pixel,
and the height of the surface is compared with it.

A point is in shadow when the surface stands above the line by more than a margin: a part of a pixel, and a slope by which a
height integrated from normals may err. Only surface that the camera sees can cast a shadow here. Of another part of the object than the
point's own, which may be thin, only the visible front does: the line must pass through it, and one that lies behind it from where it comes
into the picture of that part to where it leaves passes behind the part.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

MARGIN_PIXELS = 0.3
"""Height above the marched line, in pixels, that the surface must exceed to hide the light."""
MARGIN_SLOPE = 0.02
"""Growth of that height with the distance from the point, per unit of the picture's plane: integrated heights drift by about a degree."""
FIRST_STEP = 1.5
"""Distance from the point, in pixels, at which the march begins: the point's own neighbours cannot tell cast shadow."""

NO_REACH = 1.0e30
"""Reach of the march to a distant light: a length beyond every scene."""


class Projection(NamedTuple):
    """The projection of camera-frame points to the picture, without lens distortion."""

    perspective: bool
    scale: wp.vec2  # perspective: focal lengths in pixels; orthographic: pixels per unit
    centre: wp.vec2  # principal point in pixels


class Extent(NamedTuple):
    """The extent of a surface, beyond which the march to a light meets nothing."""

    box: wp.vec4i  # first row and column of the mask, and the last of each
    highest: float  # camera-frame z


def extent_of(height: np.ndarray, mask: np.ndarray) -> Extent:
    """Return where a surface is.

    Args:
        height: [rows, cols] camera-frame z.
        mask: [rows, cols], 0 outside the surface.
    """
    inside = mask != 0
    rows, cols = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return Extent(wp.vec4i(0, 0, -1, -1), -NO_REACH)
    return Extent(wp.vec4i(int(rows[0]), int(cols[0]), int(rows[-1]), int(cols[-1])), float(height[inside].max()))


@wp.func
def project(point: wp.vec3, perspective: bool, scale: wp.vec2, centre: wp.vec2) -> wp.vec2:
    """Return the continuous image coordinates of a camera-frame point."""
    far = wp.where(perspective, wp.max(-point[2], 1.0e-9), 1.0)
    return wp.vec2(centre[0] + scale[0] * point[0] / far, centre[1] - scale[1] * point[1] / far)


@wp.func
def unproject(u: float, v: float, z: float, perspective: bool, scale: wp.vec2, centre: wp.vec2) -> wp.vec3:
    """Return the camera-frame point of height z at continuous image coordinates."""
    far = wp.where(perspective, -z, 1.0)
    return wp.vec3((u - centre[0]) / scale[0] * far, (centre[1] - v) / scale[1] * far, z)


@wp.func
def between_pixels(height: wp.array2d(dtype=float), u: float, v: float) -> float:
    """Return the height between the four pixels around (u, v), bilinear; pixel (row r, column c) is at (c, r)."""
    c, r = int(wp.floor(u)), int(wp.floor(v))
    fu, fv = u - float(c), v - float(r)
    upper = height[r, c] * (1.0 - fu) + height[r, c + 1] * fu
    lower = height[r + 1, c] * (1.0 - fu) + height[r + 1, c + 1] * fu
    return upper * (1.0 - fv) + lower * fv


@wp.func
def in_shadow_within(height: wp.array2d(dtype=float), mask: wp.array2d(dtype=wp.uint8), row: int, col: int, toward: wp.vec3,
                     reach: float, perspective: bool, scale: wp.vec2, centre: wp.vec2, box: wp.vec4i, highest: float) -> bool:
    """Return whether the surface hides a light in this direction from this pixel before `reach`: what lies behind a light hides nothing.

    The march ends where it leaves the box of the surface, or rises above its highest point other than from behind a part.

    The mask is 0 outside the surface and elsewhere the number of the part that a pixel lies on; a surface without breaks is one part.
    """
    z = height[row, col]
    start = unproject(float(col) + 0.5, float(row) + 0.5, z, perspective, scale, centre)
    pixel = wp.where(perspective, -z, 1.0) / (0.5 * (scale[0] + scale[1]))  # what a pixel spans here
    across = wp.sqrt(toward[0] * toward[0] + toward[1] * toward[1])
    if across < 1.0e-4:
        return False  # along the line of sight
    stride = pixel / across
    travelled = FIRST_STEP * stride
    hidden, behind = bool(False), bool(False)  # literals could not change inside the loop
    own = int(mask[row, col])
    last = own  # the part that the line met last; `behind`, whether it ran behind that part's front
    for _ in range(mask.shape[0] + mask.shape[1]):
        if travelled >= reach:
            break
        point = start + travelled * toward
        if point[2] > highest and toward[2] >= 0.0 and not behind:
            break
        at = project(point, perspective, scale, centre)
        u, v = at[0] - 0.5, at[1] - 0.5
        c, r = int(wp.floor(u)), int(wp.floor(v))
        if c < box[1] - 1 or r < box[0] - 1 or c > box[3] or r > box[2]:
            break
        if c < 0 or r < 0 or c >= mask.shape[1] - 1 or r >= mask.shape[0] - 1:
            break
        part = int(mask[r, c])
        if part != 0 and int(mask[r, c + 1]) == part and int(mask[r + 1, c]) == part and int(mask[r + 1, c + 1]) == part:
            fu, fv = u - float(c), v - float(r)
            upper = height[r, c] * (1.0 - fu) + height[r, c + 1] * fu
            lower = height[r + 1, c] * (1.0 - fu) + height[r + 1, c + 1] * fu
            above = upper * (1.0 - fv) + lower * fv - point[2]
            under = above > MARGIN_PIXELS * pixel + MARGIN_SLOPE * travelled * across
            hidden = under
            if part != own:
                hidden = part == last and under != behind
            last, behind = part, under
            if hidden:
                break
        travelled += stride
    return hidden
