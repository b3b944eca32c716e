"""Measure the distances of the pixels of a view from the fused surface, by the voxels of a brick, and the distances between the surfaces of
two views where both measured the same place."""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.fusion.bricks import BLOCK, Blocks
from kernels.fusion.integrate import EMPTY, SURFACE, Volume, Voxels, voxel_number
from kernels.fusion.projection import View, image_point, in_front, line_of_sight, sight_start, to_camera, turned_back
from kernels.fusion.views import Cell, Measured, ViewArrays, read_view

ELSEWHERE, FUSED, LOST, REFUSED = 0, 1, 2, 3
"""Outcomes for a pixel: it lies in another brick, or in no cell; it has a distance to the fused surface; no voxels were measured all
around it; or other views saw its place to be empty."""
SAME_SIDE = 0.5
"""Least cosine between two normals at which two views may show the same surface: 60°."""


@wp.kernel(enable_backward=False)
def _residual_kernel(first: int, voxels: Voxels, views: wp.array(dtype=View), cells: wp.array(dtype=Cell),
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
    point = wp.transpose(view.rotation) * (away + (sight_start(view, u, v) - view.translation)) / voxels.size
    fx = point[0] - wp.floor(point[0])
    fy = point[1] - wp.floor(point[1])
    fz = point[2] - wp.floor(point[2])
    x = int(wp.floor(point[0])) - voxels.corner[0]
    y = int(wp.floor(point[1])) - voxels.corner[1]
    z = int(wp.floor(point[2])) - voxels.corner[2]
    if wp.min(wp.min(x, y), z) >= 0 and wp.max(wp.max(x, y), z) < (voxels.index.shape[0] - 1) * BLOCK:
        found = wp.int32(FUSED)
        total = float(0.0)
        for k in range(8):
            voxel_at = voxel_number(x + (k & 1), y + ((k >> 1) & 1), z + ((k >> 2) & 1), voxels.index)
            known = wp.int32(0)
            if voxel_at >= 0:
                known = int(voxels.state[voxel_at])
            if known == EMPTY:
                found = wp.int32(REFUSED)
            elif known != SURFACE and found == FUSED:
                found = wp.int32(LOST)
            if known == SURFACE:
                weight = wp.where((k & 1) != 0, fx, 1.0 - fx) * wp.where((k & 2) != 0, fy, 1.0 - fy)
                total += weight * wp.where((k & 4) != 0, fz, 1.0 - fz) * voxels.value[voxel_at]
        distance[i] = total
    fate[i] = wp.uint8(found)


def residuals(volume: Volume, views: ViewArrays) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the pixels of all views lie from the fused surface in a brick; waits for the device.
    Returns [C] float32 metres, positive outside, one for the upper left pixel of each cell; and [C] uint8, ELSEWHERE, FUSED, LOST or
    REFUSED: distances count where it is FUSED."""
    blocks: Blocks = volume.blocks
    count = len(views.cells)
    distance: Any = wp.zeros(count, dtype=float, device=blocks.device)
    fate: Any = wp.zeros(count, dtype=wp.uint8, device=blocks.device)
    devices.launch(_residual_kernel, count, [volume.voxels(), views.views, views.cells], [distance, fate], device=blocks.device)
    return to_numpy(distance), to_numpy(fate)


@wp.kernel(enable_backward=False)
def _compare_kernel(first: int, reach: float, images: Measured, points: wp.array(dtype=wp.vec3),
                    normals: wp.array(dtype=wp.vec3), variance: wp.array(dtype=float),
                    # outputs
                    distance: wp.array2d(dtype=float), expected: wp.array2d(dtype=float)):
    i = first + wp.tid()
    for number in range(images.views.shape[0]):
        view = images.views[number]
        there = to_camera(view, points[i])
        if in_front(view, there):
            reading = read_view(view, there, image_point(view, there), images)
            if reading.known and wp.dot(turned_back(view, reading.normal), normals[i]) > SAME_SIDE and wp.abs(reading.distance) < reach:
                distance[i, number] = reading.distance
                expected[i, number] = wp.sqrt(reading.variance + variance[i])


def compare_views(views: ViewArrays, points: np.ndarray, normals: np.ndarray, variance: np.ndarray, *, reach: float,
                  device: str) -> tuple[np.ndarray, np.ndarray]:
    """Compare points that one view measured with the surfaces that others measured there; waits for the device.

    Args:
        points, normals: [n, 3] metres in the coordinates of the views, and unit vectors of the world frame.
        variance: [n] square metres, of each point along its normal.
        reach: metres; surfaces farther off are other surfaces.

    Returns:
        [n, V] float32: the distance of each point from the surface of each view along its normal, metres, and what standard deviation the
        difference of the two has; 0 where they cannot be compared.
    """
    distance, expected = (wp.zeros((len(points), views.count), dtype=float, device=device) for _ in range(2))
    devices.launch(_compare_kernel, len(points), [
        reach, views.measured(),
        *(wp.array(values.astype(np.float32), dtype=kind, device=device) for values, kind in (
            (points, wp.vec3), (normals, wp.vec3), (variance, float)))], [distance, expected], device=device, uneven=True)
    return to_numpy(distance), to_numpy(expected)
