"""Blend colours, materials and normals at points of the surface from the views that see each point best.

A view counts at a point where its own measured surface is there (nothing hides the point), its pixels show one surface around it, and the
line of sight is not grazing. Its weight falls with the angle to the view, with the distance in units of pixels, and to 0 towards the
borders of its valid pixels, so that no seams show where a view ends.

Source: Buehler et al., "Unstructured Lumigraph Rendering", SIGGRAPH 2001 (weights of angle, resolution and visibility, smooth to 0 at the
borders of images).
"""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.fusion.projection import image_point, in_front, to_camera, toward_camera, turned_back
from kernels.fusion.views import Measured, ViewArrays, read_view

SHARPNESS = 4.0
"""Power of the weights: the best views win where they differ, and blend where they are about alike."""
OFF_SURFACE = 4.0
"""Largest distance of a point from what a view measured, in standard deviations of both, at which the view sees this point."""


class Gathered(NamedTuple):
    """Blended values of the views at points."""

    values: Any  # wp.array [n, C] weighted means; 0 where no view counts
    weight: Any  # wp.array [n] sum of the weights; 0 where no view counts
    best: Any  # wp.array [n] int32, the view with the largest weight, −1 where none counts
    seen: Any  # wp.array [n] int32, count of views that count


@wp.func
def _bilinear(plane: wp.array2d(dtype=float), place: int, cols: int, fu: float, fv: float, channel: int) -> float:
    upper = (1.0 - fu) * plane[place, channel] + fu * plane[place + 1, channel]
    lower = (1.0 - fu) * plane[place + cols, channel] + fu * plane[place + cols + 1, channel]
    return (1.0 - fv) * upper + fv * lower


@wp.kernel(enable_backward=False)
def _gather_kernel(first: int, slack: float, vectors: int, images: Measured, layers: wp.array2d(dtype=float),
                   feather: wp.array2d(dtype=float), points: wp.array(dtype=wp.vec3), normals: wp.array(dtype=wp.vec3),
                   uncertainty: wp.array(dtype=float),
                   # outputs
                   values: wp.array2d(dtype=float), weight: wp.array(dtype=float), best: wp.array(dtype=int), seen: wp.array(dtype=int)):
    i = first + wp.tid()
    point = points[i]
    channels = layers.shape[1]
    total = float(0.0)
    largest = float(0.0)
    chosen = wp.int32(-1)
    number_seen = wp.int32(0)
    for c in range(channels):
        values[i, c] = 0.0
    for number in range(images.views.shape[0]):
        view = images.views[number]
        there = to_camera(view, point)
        if in_front(view, there):
            uv = image_point(view, there)
            reading = read_view(view, there, uv, images)
            # the angle to the surface of all views, whose normals are surer than those of one
            toward = wp.transpose(view.rotation) * toward_camera(view, there)
            cosine = wp.dot(normals[i], toward) / wp.length(toward)
            limit = OFF_SURFACE * wp.sqrt(reading.sigma * reading.sigma + uncertainty[i] * uncertainty[i]) + slack
            if (reading.known and cosine > 0.0 and wp.abs(reading.distance) <= limit
                    and wp.dot(turned_back(view, reading.normal), normals[i]) > 0.0):
                u = uv[0] - 0.5
                v = uv[1] - 0.5
                fu = u - wp.floor(u)
                fv = v - wp.floor(v)
                place = view.first + (int(wp.floor(v)) - view.first_row) * view.cols + int(wp.floor(u)) - view.first_col
                near = _bilinear(feather, place, view.cols, fu, fv, 0)
                scale = wp.min(view.focal[0], view.focal[1]) / wp.where(view.orthographic, 1.0, -there[2])  # pixels for each metre
                w = near * wp.pow(cosine * scale * 1.0e-3, SHARPNESS)
                if w > 0.0:
                    number_seen += 1
                    total += w
                    if w > largest:
                        largest = w
                        chosen = number
                    for c in range(channels):
                        if c >= vectors:
                            values[i, c] = values[i, c] + w * _bilinear(layers, place, view.cols, fu, fv, c)
                    for k in range(vectors // 3):
                        given = wp.vec3(_bilinear(layers, place, view.cols, fu, fv, 3 * k),
                                        _bilinear(layers, place, view.cols, fu, fv, 3 * k + 1),
                                        _bilinear(layers, place, view.cols, fu, fv, 3 * k + 2))
                        turned = wp.transpose(view.rotation) * given
                        values[i, 3 * k] = values[i, 3 * k] + w * turned[0]
                        values[i, 3 * k + 1] = values[i, 3 * k + 1] + w * turned[1]
                        values[i, 3 * k + 2] = values[i, 3 * k + 2] + w * turned[2]
    if total > 0.0:
        for c in range(channels):
            values[i, c] = values[i, c] / total
    weight[i] = total
    best[i] = chosen
    seen[i] = number_seen


def gather(views: ViewArrays, layers: Any, feather: Any, points: Any, normals: Any, sigma: Any, *, vectors: int, slack: float,
           device: str) -> Gathered:
    """Blend what views show at points; returns before the device is done. Means of vectors are not of unit length.

    Args:
        layers: wp.array [P, C] float, values of all pixels of the views, one view after another.
        feather: wp.array [P, 1] float, 0…1, how much each pixel counts.
        points, normals: wp.array [n] of vec3, metres in the coordinates of the views, and unit vectors of the world frame.
        sigma: wp.array [n] metres, standard deviation of the place of each point.
        vectors: count of the first channels that are vectors of the camera frame, three by three; they are turned to the world frame.
        slack: distance in metres by which a point may lie off its surface beside that, as on a simplified mesh.
    """
    count, channels = len(points), layers.shape[1]
    values = wp.empty((count, channels), dtype=float, device=device)
    weight = wp.empty(count, dtype=float, device=device)
    best, seen = (wp.empty(count, dtype=int, device=device) for _ in range(2))
    devices.launch(_gather_kernel, count, [slack, vectors, views.measured(), layers, feather, points, normals, sigma],
                   [values, weight, best, seen], device=device, uneven=True)
    return Gathered(values, weight, best, seen)
