"""How far the surfaces of two views lie apart where both measured the same place."""

from typing import Any

import warp as wp

from kernels import device as devices
from kernels.fusion.views import View, ViewArrays, image_point, line_of_sight, read_view, to_camera

SAME_SIDE = 0.5
"""Least cosine between two normals at which two views may show the same surface: 60°."""


@wp.kernel(enable_backward=False)
def _compare_kernel(first: int, number: int, count: int, reach: float, views: wp.array(dtype=View), inverse: wp.array(dtype=float),
                    sigma: wp.array(dtype=float), normal: wp.array(dtype=wp.vec3), cell: wp.array(dtype=wp.uint8),
                    pixels: wp.array(dtype=int),
                    # outputs
                    distance: wp.array2d(dtype=float), expected: wp.array2d(dtype=float)):
    i = first + wp.tid()
    view = views[number]
    row = pixels[i] // view.cols
    col = pixels[i] - row * view.cols
    place = view.first + pixels[i]
    there = line_of_sight(view, float(col + view.first_col) + 0.5, float(row + view.first_row) + 0.5) / inverse[place]
    back = wp.transpose(view.rotation)
    point = back * (there - view.translation)
    own = back * normal[place]
    cosine = wp.dot(normal[place], -there) / wp.length(there)
    along = wp.length(there) * inverse[place] * sigma[place]
    for other in range(count):
        expected[i, other] = 0.0
        if other != number:
            away = to_camera(views[other], point)
            if away[2] < 0.0:
                reading = read_view(views[other], away, image_point(views[other], away), inverse, sigma, normal, cell)
                if reading.known and wp.dot(reading.normal, own) > SAME_SIDE and wp.abs(reading.distance) < reach:
                    distance[i, other] = reading.distance
                    expected[i, other] = wp.sqrt(reading.variance + along * along * cosine * cosine)


def compare_views(views: ViewArrays, number: int, pixels: Any, *, reach: float, device: str) -> tuple[Any, Any]:
    """Compare pixels of one view with the surfaces that the others measured there.

    Args:
        views: all range images.
        number: of the view whose pixels are compared.
        pixels: wp.array [n] int32, row-major places of pixels in its image that are corners of a cell and have a normal.
        reach: metres; surfaces farther off are other surfaces.
        device: where the arrays are.

    Returns:
        wp.array [n, V] float: the distance of each pixel's point from the surface of each view along its normal, metres, and what standard
        deviation the difference of the two has; 0 where they cannot be compared.
    """
    distance, expected = (wp.zeros((len(pixels), views.count), dtype=float, device=device) for _ in range(2))
    devices.launch(_compare_kernel, len(pixels), [number, views.count, reach, views.views, views.inverse, views.sigma, views.normal,
                                                  views.cell, pixels], [distance, expected], device=device, uneven=True)
    return distance, expected

