"""How far the surfaces of two views lie apart where both measured the same place."""

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.fusion.projection import View, image_point, in_front, to_camera, turned_back
from kernels.fusion.views import Cell, ViewArrays, read_view

SAME_SIDE = 0.5
"""Least cosine between two normals at which two views may show the same surface: 60°."""


@wp.kernel(enable_backward=False)
def _compare_kernel(first: int, skipped: int, count: int, reach: float, views: wp.array(dtype=View), cell: wp.array(dtype=int),
                    cells: wp.array(dtype=Cell), points: wp.array(dtype=wp.vec3), normals: wp.array(dtype=wp.vec3),
                    variance: wp.array(dtype=float),
                    # outputs
                    distance: wp.array2d(dtype=float), expected: wp.array2d(dtype=float)):
    i = first + wp.tid()
    for number in range(count):
        if number != skipped:
            view = views[number]
            there = to_camera(view, points[i])
            if in_front(view, there):
                reading = read_view(view, there, image_point(view, there), cell, cells)
                if (reading.known and wp.dot(turned_back(view, reading.normal), normals[i]) > SAME_SIDE
                        and wp.abs(reading.distance) < reach):
                    distance[i, number] = reading.distance
                    expected[i, number] = wp.sqrt(reading.variance + variance[i])


def compare_views(views: ViewArrays, points: np.ndarray, normals: np.ndarray, variance: np.ndarray, *, skipped: int, reach: float,
                  device: str) -> tuple[np.ndarray, np.ndarray]:
    """Compare points that one view measured with the surfaces that others measured there.

    Args:
        views: the range images.
        points: [n, 3] metres, in the coordinates of the views.
        normals: [n, 3] unit, world frame.
        variance: [n] square metres, of each point along its normal.
        skipped: number of the view that measured the points, which are not compared with it; −1 where it is not among the views.
        reach: metres; surfaces farther off are other surfaces.
        device: where the arrays are.

    Returns:
        [n, V] float32: the distance of each point from the surface of each view along its normal, metres, and what standard deviation the
        difference of the two has; 0 where they cannot be compared.

    Convention:
        Waits for the device.
    """
    distance, expected = (wp.zeros((len(points), views.count), dtype=float, device=device) for _ in range(2))
    devices.launch(_compare_kernel, len(points), [
        skipped, views.count, reach, views.views, views.cell, views.cells,
        *(wp.array(values.astype(np.float32), dtype=kind, device=device) for values, kind in (
            (points, wp.vec3), (normals, wp.vec3), (variance, float)))], [distance, expected], device=device, uneven=True)
    return distance.numpy(), expected.numpy()
