"""How far each pixel of a view lies from the fused surface, as the voxels of a brick tell."""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.fusion.bricks import BLOCK, Blocks
from kernels.fusion.integrate import EMPTY, SURFACE, Volume, voxel_number
from kernels.fusion.projection import View, line_of_sight, sight_start
from kernels.fusion.views import Cell, ViewArrays

ELSEWHERE, FUSED, LOST, REFUSED = 0, 1, 2, 3
"""What became of a pixel: it lies in another brick, or in no cell; it has a distance to the fused surface; no voxels were measured all
around it; or other views saw its place to be empty."""


@wp.kernel(enable_backward=False)
def _residual_kernel(first: int, voxel: float, corner: wp.vec3i, index: wp.array3d(dtype=int), value: wp.array(dtype=float),
                     state: wp.array(dtype=wp.uint8), views: wp.array(dtype=View), cells: wp.array(dtype=Cell),
                     # outputs
                     distance: wp.array(dtype=float), fate: wp.array(dtype=wp.uint8)):
    i = first + wp.tid()
    cell = cells[i]
    view = views[cell.view]
    row = (cell.place - view.first) // view.cols
    col = cell.place - view.first - row * view.cols
    found = wp.int32(ELSEWHERE)
    u = float(col + view.first_col) + 0.5
    v = float(row + view.first_row) + 0.5
    ray = line_of_sight(view, u, v)
    away = wp.where(view.orthographic, ray * cell.linear[0], ray / cell.linear[0])
    point = wp.transpose(view.rotation) * (away + (sight_start(view, u, v) - view.translation)) / voxel
    fx = point[0] - wp.floor(point[0])
    fy = point[1] - wp.floor(point[1])
    fz = point[2] - wp.floor(point[2])
    x = int(wp.floor(point[0])) - corner[0]
    y = int(wp.floor(point[1])) - corner[1]
    z = int(wp.floor(point[2])) - corner[2]
    if wp.min(wp.min(x, y), z) >= 0 and wp.max(wp.max(x, y), z) < (index.shape[0] - 1) * BLOCK:
        found = wp.int32(FUSED)
        total = float(0.0)
        for k in range(8):
            voxel_at = voxel_number(x + (k & 1), y + ((k >> 1) & 1), z + ((k >> 2) & 1), index)
            known = wp.int32(0)
            if voxel_at >= 0:
                known = int(state[voxel_at])
            if known == EMPTY:
                found = wp.int32(REFUSED)
            elif known != SURFACE and found == FUSED:
                found = wp.int32(LOST)
            if known == SURFACE:
                weight = wp.where((k & 1) != 0, fx, 1.0 - fx) * wp.where((k & 2) != 0, fy, 1.0 - fy)
                total += weight * wp.where((k & 4) != 0, fz, 1.0 - fz) * value[voxel_at]
        distance[i] = total
    fate[i] = wp.uint8(found)


def residuals(volume: Volume, views: ViewArrays) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the pixels of all views lie from the fused surface in a brick.

    Returns:
        [C] float32 metres, positive outside, one for the upper left pixel of each cell; and [C] uint8, ELSEWHERE, FUSED, LOST or REFUSED:
        distances count where it is FUSED.

    Convention:
        Waits for the device.
    """
    blocks: Blocks = volume.blocks
    count = len(views.cells)
    distance: Any = wp.zeros(count, dtype=float, device=blocks.device)
    fate: Any = wp.zeros(count, dtype=wp.uint8, device=blocks.device)
    devices.launch(_residual_kernel, count, [blocks.voxel, wp.vec3i(*blocks.corner), blocks.index, volume.value, volume.state, views.views,
                                             views.cells], [distance, fate], device=blocks.device)
    return distance.numpy(), fate.numpy()
