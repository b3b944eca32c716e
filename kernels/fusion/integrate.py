"""The truncated signed distance of every voxel of a brick, from all range images at once.

Each voxel gathers what the views measured on their lines of sight through it: the distance to the measured surface along its normal,
weighted by the inverse of its variance. Nothing is accumulated from launch to launch, so that a voxel has the same value to the last bit
whichever brick computes it and in whichever order views are given to the same voxel.

Three rules keep thin parts and gaps as they are. Distances count within the truncation alone. Where the normals of the views
disagree, as on both sides of a thin sheet, at an edge, or in a narrow gap, those views count whose surface is turned like that of the
nearest one. And a voxel inside of what was measured that as many views saw to be empty as measured a surface there is no surface; outside
of it a voxel is empty, as those see who look past the edge of a part.

Source: Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH 1996 (weights, the space in front
of a surface is empty); Bylow et al., "Real-Time Camera Tracking and 3D Reconstruction Using Signed Distance Functions", RSS 2013 (distance
along the normal).
"""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.fusion.bricks import BLOCK, VOXELS, Blocks, find_watching
from kernels.fusion.projection import View, image_point, in_front, to_camera, turned_back
from kernels.fusion.views import ALONG, Measured, ViewArrays, read_view, truncation

AGREEING = 0.85
"""Length of the weighted mean of the normals from which on all of them count: they then lie within some 45° of each other."""
TURNED = 0.5
"""Cosine between a normal and that of the nearest surface from which on its view counts where normals disagree: 60°."""

NEAR_SIGMAS = 3.0
"""Distance from a measured surface in standard deviations within which a voxel may be that surface. A voxel farther behind it is hidden
from the view, which is no evidence against another that sees the voxel to be empty."""

UNKNOWN, SURFACE, EMPTY = 0, 1, 2
"""States of a voxel: not measured; near a measured surface; inside of one, and measured by fewer views than saw it to be empty."""


@wp.struct
class Voxels:
    """The voxels of the blocks of a brick, as kernels read them."""

    size: float  # side of a voxel, metres
    corner: wp.vec3i  # lattice coordinates of the lowest voxel
    place: wp.array(dtype=wp.vec3i)  # of `Blocks`
    index: wp.array3d(dtype=int)
    value: wp.array(dtype=float)  # of `Volume`
    variance: wp.array(dtype=float)
    state: wp.array(dtype=wp.uint8)


class Volume(NamedTuple):
    """The voxels of the blocks of a brick."""

    blocks: Blocks
    value: Any  # wp.array [VOXELS B] metres, signed distance, positive outside; 0 where there is none
    variance: Any  # wp.array [VOXELS B] square metres
    state: Any  # wp.array [VOXELS B] uint8

    def voxels(self) -> Any:
        """Return the `Voxels` of this volume."""
        voxels = Voxels()
        voxels.size, voxels.corner = self.blocks.voxel, wp.vec3i(*self.blocks.corner)
        voxels.place, voxels.index = self.blocks.place, self.blocks.index
        voxels.value, voxels.variance, voxels.state = self.value, self.variance, self.state
        return voxels


@wp.func
def voxel_position(i: int, place: wp.array(dtype=wp.vec3i)) -> wp.vec3i:
    """Return the coordinates of a voxel in its brick; voxels of a block follow each other with x the fastest."""
    block = i // VOXELS
    inside = i - block * VOXELS
    return BLOCK * place[block] + wp.vec3i(inside % BLOCK, (inside // BLOCK) % BLOCK, inside // (BLOCK * BLOCK))


@wp.func
def voxel_number(x: int, y: int, z: int, index: wp.array3d(dtype=int)) -> int:
    """Return the number of a voxel of a brick, −1 where its block does not exist."""
    bx = x // BLOCK
    by = y // BLOCK
    bz = z // BLOCK
    if bx >= index.shape[2] or by >= index.shape[1] or bz >= index.shape[0]:
        return -1
    block = index[bz, by, bx]
    if block < 0:
        return -1
    return block * VOXELS + ((z - bz * BLOCK) * BLOCK + (y - by * BLOCK)) * BLOCK + (x - bx * BLOCK)


@wp.func
def near_surface(sigma: float, voxel: float) -> float:
    """Return the distance within which a voxel may be the measured surface."""
    return wp.max(voxel, NEAR_SIGMAS * sigma)


@wp.func
def is_clear(view: View, point: wp.vec3, at: wp.vec2, reach: float, clear: wp.array(dtype=float)) -> bool:
    """Return whether a view saw that a camera-frame point is empty: it lies nearer than everything that was measured around its pixel."""
    col = int(wp.floor(at[0])) - view.first_col
    row = int(wp.floor(at[1])) - view.first_row
    if col < 0 or row < 0 or col >= view.cols or row >= view.rows:
        return False
    return -point[2] + reach < clear[view.first + row * view.cols + col]


@wp.kernel(enable_backward=False)
def _integrate_kernel(first: int, count: int, watched: wp.array2d(dtype=wp.int16), images: Measured,
                      # outputs
                      voxels: Voxels):
    i = first + wp.tid()
    block = i // VOXELS
    voxel = voxels.size
    at = voxel_position(i, voxels.place)
    at = at + voxels.corner
    point = voxel * wp.vec3(float(at[0]), float(at[1]), float(at[2]))
    weights = float(0.0)
    total = float(0.0)
    spread = float(0.0)
    normals = wp.vec3(0.0, 0.0, 0.0)
    nearest = float(1.0e30)
    reference = wp.vec3(0.0, 0.0, 0.0)
    near = wp.int32(0)
    empty = wp.int32(0)
    for k in range(count):
        number = int(watched[block, k])
        if number < 0:
            break
        view = images.views[number]
        there = to_camera(view, point)
        if in_front(view, there):
            uv = image_point(view, there)
            reading = read_view(view, there, uv, images)
            reach = truncation(reading.sigma, voxel)
            if reading.known and wp.abs(reading.distance) <= reach and reading.along >= -ALONG * reach:
                w = reading.weight
                weights += w
                total += w * reading.distance
                spread += w * w * reading.variance
                normals += w * turned_back(view, reading.normal)
                if wp.abs(reading.distance) <= near_surface(reading.sigma, voxel):
                    near += 1
                if wp.abs(reading.distance) < nearest:
                    nearest = wp.abs(reading.distance)
                    reference = turned_back(view, reading.normal)
            elif reading.known:
                if reading.distance > reach:
                    empty += 1
            elif is_clear(view, there, uv, truncation(0.0, voxel), images.clear):
                empty += 1
    if weights > 0.0 and wp.length(normals) < AGREEING * weights:
        weights = float(0.0)
        total = float(0.0)
        spread = float(0.0)
        for k in range(count):
            number = int(watched[block, k])
            if number < 0:
                break
            view = images.views[number]
            there = to_camera(view, point)
            if in_front(view, there):
                reading = read_view(view, there, image_point(view, there), images)
                reach = truncation(reading.sigma, voxel)
                if (reading.known and wp.abs(reading.distance) <= reach and reading.along >= -ALONG * reach
                        and wp.dot(turned_back(view, reading.normal), reference) >= TURNED):
                    w = reading.weight
                    weights += w
                    total += w * reading.distance
                    spread += w * w * reading.variance
    known = wp.int32(UNKNOWN)
    if weights > 0.0:
        known = wp.int32(SURFACE)
        voxels.value[i] = total / weights
        apart = wp.abs(total / weights) - nearest  # beside edges views differ by more than their noise: of two, this is that of the mean
        voxels.variance[i] = wp.max(spread / (weights * weights), apart * apart)
    if empty > 0 and empty >= near and total <= 0.0:
        known = wp.int32(EMPTY)
    voxels.state[i] = wp.uint8(known)


def integrate(blocks: Blocks, views: ViewArrays) -> Volume:
    """Compute the signed distance of every voxel of blocks, found with these views by find_blocks; returns before the device is done."""
    count, device = blocks.count * VOXELS, blocks.device
    value, variance = (wp.zeros(count, dtype=float, device=device) for _ in range(2))
    state = wp.zeros(count, dtype=wp.uint8, device=device)
    volume = Volume(blocks, value, variance, state)
    if count:
        devices.launch(_integrate_kernel, count, [views.count, find_watching(blocks, views), views.measured()], [volume.voxels()],
                       device=device, uneven=True)
    return volume
