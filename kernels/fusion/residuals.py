"""How far each pixel of a view lies from the fused surface, as the voxels of a brick tell."""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.fusion.bricks import BRICK_VOXELS, Blocks
from kernels.fusion.integrate import EMPTY, SURFACE, Volume, voxel_number
from kernels.fusion.views import View, ViewArrays, line_of_sight

ELSEWHERE, FUSED, LOST, REFUSED = 0, 1, 2, 3
"""What became of a pixel: it lies in another brick, or in no cell; it has a distance to the fused surface; no voxels were measured all
around it; or other views saw its place to be empty."""


@wp.kernel(enable_backward=False)
def _residual_kernel(first: int, number: int, voxel: float, corner: wp.vec3i, index: wp.array(dtype=int), value: wp.array(dtype=float),
                     state: wp.array(dtype=wp.uint8), views: wp.array(dtype=View), inverse: wp.array(dtype=float),
                     cell: wp.array(dtype=wp.uint8),
                     # outputs
                     distance: wp.array(dtype=float), fate: wp.array(dtype=wp.uint8)):
    i = first + wp.tid()
    view = views[number]
    row = i // view.cols
    col = i - row * view.cols
    found = wp.int32(ELSEWHERE)
    if cell[view.first + i] != wp.uint8(0):
        ray = line_of_sight(view, float(col + view.first_col) + 0.5, float(row + view.first_row) + 0.5)
        point = wp.transpose(view.rotation) * (ray / inverse[view.first + i] - view.translation) / voxel
        fx = point[0] - wp.floor(point[0])
        fy = point[1] - wp.floor(point[1])
        fz = point[2] - wp.floor(point[2])
        x = int(wp.floor(point[0])) - corner[0]
        y = int(wp.floor(point[1])) - corner[1]
        z = int(wp.floor(point[2])) - corner[2]
        if wp.min(wp.min(x, y), z) >= 0 and wp.max(wp.max(x, y), z) < BRICK_VOXELS:
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


def residuals(volume: Volume, views: ViewArrays, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the pixels of a view lie from the fused surface in a brick.

    Returns:
        [rows × cols] float32 metres, positive outside; and [rows × cols] uint8, ELSEWHERE, FUSED, LOST or REFUSED: distances count where
        it is FUSED.

    Convention:
        Waits for the device. Only pixels that are the upper left corner of a cell count.
    """
    blocks: Blocks = volume.blocks
    rows, cols = views.shapes[number]
    distance: Any = wp.zeros(rows * cols, dtype=float, device=blocks.device)
    fate: Any = wp.zeros(rows * cols, dtype=wp.uint8, device=blocks.device)
    devices.launch(_residual_kernel, rows * cols, [number, blocks.voxel, wp.vec3i(*blocks.corner), blocks.index, volume.value, volume.state,
                                                   views.views, views.inverse, views.cell], [distance, fate], device=blocks.device)
    return distance.numpy(), fate.numpy()
