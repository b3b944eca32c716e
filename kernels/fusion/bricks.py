"""Bricks: the cubes into which space is cut, each with an array of blocks of 8³ voxels that exist near measured surface alone.

A brick has at most BRICK³ blocks, and one more on its high side along each axis, which its last cells need. Its blocks are found by their
index in a dense array, so that neighbours are found without a search. Voxels lie on one lattice for all bricks, voxel (i, j, k) at that
many voxel sizes from the origin.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.fusion.projection import View, depth_of, image_point, line_of_sight, pixel_metres, sight_start, to_camera
from kernels.fusion.views import ALONG, TILE, TRUNCATION_VOXELS, WIDER, Cell, ViewArrays, truncation

BLOCK = 8
"""Voxels along each side of a block."""
VOXELS = BLOCK**3
BRICK = 32
"""Most blocks along each side of a brick."""
BRICK_VOXELS = BRICK * BLOCK
"""Most voxels along each side of a brick."""
VOXEL_BYTES = 27
"""Bytes of one voxel in every array of a brick together: of Volume, and what `extract` counts and numbers."""
MEMORY_BOUND = (BRICK + 1) ** 3 * VOXELS * VOXEL_BYTES
"""Most bytes on the device that the voxels of a brick can take, where every block exists; the triangles come on top."""

STEP_BLOCKS = 0.5
"""Distance, in blocks, of the points on the line of sight and across it whose blocks are marked."""
MARGIN_VOXELS = 1.8
"""Distance, in voxels, around such a point within which blocks are marked: the corners of a cell lie as far apart."""


class Blocks(NamedTuple):
    """The blocks of a brick that exist."""

    index: Any  # wp.array [side, side, side] int32 by z, y and x, number of each block, −1 where there is none
    place: Any  # wp.array [B] of vec3i, x, y and z of each block in its brick
    count: int
    corner: tuple[int, int, int]  # lattice coordinates, in voxels, of the lowest voxel
    voxel: float  # metres
    device: str


@wp.kernel(enable_backward=False)
def _mark_kernel(first: int, voxel: float, corner: wp.vec3, views: wp.array(dtype=View), cells: wp.array(dtype=Cell),
                 # outputs
                 marked: wp.array3d(dtype=wp.uint8)):
    side = marked.shape[0]
    cell = cells[first + wp.tid()]
    view = views[cell.view]
    row = (cell.place - view.first) // view.cols
    col = cell.place - view.first - row * view.cols
    four = cell.linear
    largest = depth_of(view, wp.max(wp.max(four[0], four[1]), wp.max(four[2], four[3])))
    smallest = depth_of(view, wp.min(wp.min(four[0], four[1]), wp.min(four[2], four[3])))
    nearest = wp.min(largest, smallest)
    farthest = wp.max(largest, smallest)
    step = STEP_BLOCKS * float(BLOCK) * voxel
    across = pixel_metres(view, farthest)
    most = wp.max(across, farthest - nearest)
    parts = int(most / step) + 1
    reach = truncation(cell.largest, voxel)
    half = int(reach / step) + 1
    size = float(BLOCK) * voxel
    margin = MARGIN_VOXELS * voxel
    back = wp.transpose(view.rotation)
    for a in range(parts):
        fv = (float(a) + 0.5) / float(parts)
        for b in range(parts):
            fu = (float(b) + 0.5) / float(parts)
            depth = depth_of(view, (1.0 - fv) * ((1.0 - fu) * four[0] + fu * four[1]) + fv * ((1.0 - fu) * four[2] + fu * four[3]))
            u = float(col + view.first_col) + 0.5 + fu
            v = float(row + view.first_row) + 0.5 + fv
            ray = line_of_sight(view, u, v)
            length = wp.length(ray)
            start = sight_start(view, u, v) - view.translation
            for s in range(-half, half + 1):
                along = depth + wp.clamp(float(s) * step, -reach, reach) / length
                point = back * (ray * along + start) - corner
                x0 = int(wp.floor((point[0] - margin) / size))
                x1 = int(wp.floor((point[0] + margin) / size))
                y0 = int(wp.floor((point[1] - margin) / size))
                y1 = int(wp.floor((point[1] + margin) / size))
                z0 = int(wp.floor((point[2] - margin) / size))
                z1 = int(wp.floor((point[2] + margin) / size))
                for z in range(wp.max(z0, 0), wp.min(z1, side - 1) + 1):
                    for y in range(wp.max(y0, 0), wp.min(y1, side - 1) + 1):
                        for x in range(wp.max(x0, 0), wp.min(x1, side - 1) + 1):
                            marked[z, y, x] = wp.uint8(1)


def find_blocks(views: ViewArrays, voxel: float, corner: tuple[int, int, int], blocks: int = BRICK, *, device: str) -> Blocks:
    """Find the blocks of a brick that come near a measured surface; waits for the device.
    `corner`: lattice coordinates of the lowest voxel of the brick; voxel (0, 0, 0) lies at the origin of the views' coordinates."""
    side = blocks + 1
    marked = wp.zeros((side, side, side), dtype=wp.uint8, device=device)
    low = wp.vec3(*(float(voxel * c) for c in corner))
    devices.launch(_mark_kernel, len(views.cells), [voxel, low, views.views, views.cells], [marked], device=device, uneven=True)
    z, y, x = np.nonzero(to_numpy(marked))
    index = np.full((side, side, side), -1, dtype=np.int32)
    index[z, y, x] = np.arange(len(x), dtype=np.int32)
    place = wp.array(np.stack([x, y, z], axis=-1).astype(np.int32), dtype=wp.vec3i, device=device)
    return Blocks(wp.array(index, dtype=int, device=device), place, len(x), corner, voxel, device)


@wp.kernel(enable_backward=False)
def _watch_kernel(first: int, voxel: float, corner: wp.vec3i, count: int, place: wp.array(dtype=wp.vec3i), views: wp.array(dtype=View),
                  farthest: wp.array(dtype=float),
                  # outputs
                  watched: wp.array2d(dtype=wp.int16)):
    i = first + wp.tid()
    at = corner + BLOCK * place[i]
    half = 0.5 * float(BLOCK) * voxel
    centre = voxel * wp.vec3(float(at[0]), float(at[1]), float(at[2]))
    centre = centre + wp.vec3(half, half, half)
    radius = 1.7320508 * half
    found = wp.int32(0)
    for number in range(count):
        view = views[number]
        point = to_camera(view, centre)
        near = -point[2] - radius
        seen = bool(near <= radius)  # so close that its outline is not bounded
        if near > radius or view.orthographic:
            uv = image_point(view, point)
            slope = wp.sqrt(point[0] * point[0] + point[1] * point[1]) / near
            reach = wp.max(view.focal[0], view.focal[1]) * radius / near * (1.0 + slope) * wp.where(view.distorted, WIDER, 1.0) + 2.0
            if view.orthographic:
                reach = wp.max(view.focal[0], view.focal[1]) * radius + 2.0
            across = uv[0] - float(view.first_col)
            down = uv[1] - float(view.first_row)
            c0 = wp.max(int(wp.floor((across - reach) / float(TILE))), 0)
            r0 = wp.max(int(wp.floor((down - reach) / float(TILE))), 0)
            tiles = (view.cols + TILE - 1) // TILE
            c1 = wp.min(int(wp.floor((across + reach) / float(TILE))), tiles - 1)
            r1 = wp.min(int(wp.floor((down + reach) / float(TILE))), (view.rows + TILE - 1) // TILE - 1)
            far = float(0.0)
            for r in range(r0, r1 + 1):
                for c in range(c0, c1 + 1):
                    far = wp.max(far, farthest[view.first_tile + r * tiles + c])
            seen = far > 0.0 and near - ALONG * TRUNCATION_VOXELS * voxel < far
        if seen:
            watched[i, found] = wp.int16(number)
            found += 1
    if found < count:
        watched[i, found] = wp.int16(-1)


def find_watching(blocks: Blocks, views: ViewArrays) -> Any:
    """Return which views can see each block, wp.array [B, V] int16: their numbers, and −1 after the last where there are fewer."""
    watched = wp.empty((blocks.count, views.count), dtype=wp.int16, device=blocks.device)
    devices.launch(_watch_kernel, blocks.count, [blocks.voxel, wp.vec3i(*blocks.corner), views.count, blocks.place, views.views,
                                                 views.farthest],
                   [watched], device=blocks.device)
    return watched
