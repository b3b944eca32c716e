"""Light that the patches of a surface send each other: form factors from points, normals and areas, with hidden pairs left out.

Source: Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991: on a Lambertian surface radiance = direct + ρ K radiance
with K of this file, so that the direct light follows from the measured radiance without a series of bounces.
"""

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.surface.shadows import Projection, project

LEAST_FACTOR = 1.0e-4
"""Least form factor of a pair that is tested for an obstacle between its patches: all smaller ones together change a reading by less than a
part in a thousand."""
SIGHT_STEPS = 8
"""Number of points on the line between two patches at which the height is looked up."""
SIGHT_MARGIN_PIXELS = 1.0
"""Distance, in pixels, by which the surface must stand above the line between two patches to hide it: patches are coarse."""


def form_factors(points: np.ndarray, normals: np.ndarray, areas: np.ndarray, height: wp.array, mask: wp.array,
                 projection: Projection, *, device: str) -> wp.array:
    """Return the form factors K[i, j] = cosᵢ cosⱼ Aⱼ / (π r²) between patches; 0 where something stands between.

    Args:
        points: [n, 3] camera-frame centres.
        normals: [n, 3] unit.
        areas: [n] in the square of the points' unit.
        height: [rows, cols] float32 camera-frame z.
        mask: [rows, cols] uint8.
        projection: of the camera.
        device: where.

    Returns:
        [n, n] float32 on the device: radiance that patch i of albedo 1 sends on, per radiance of patch j. The distance between
        neighbours is kept from vanishing by the size of the patch. Not synchronised on CUDA.

    Raises:
        ArrayError: shapes that do not fit.
    """
    count = len(points)
    if points.shape != (count, 3) or normals.shape != (count, 3) or areas.shape != (count,) or count == 0:
        raise ArrayError(f"points are {points.shape}, normals {normals.shape}, areas {areas.shape}: give [n, 3], [n, 3] and [n]")
    factors = wp.empty((count, count), dtype=wp.float32, device=device)
    devices.launch(_factor_kernel, count,
                   [wp.array(points, dtype=wp.vec3, device=device), wp.array(normals, dtype=wp.vec3, device=device),
                    wp.array(areas, dtype=wp.float32, device=device), height, mask,
                    projection.perspective, projection.scale, projection.centre], [factors], device=device)
    return factors


@wp.func
def _hidden(a: wp.vec3, b: wp.vec3, height: wp.array2d(dtype=float), mask: wp.array2d(dtype=wp.uint8), perspective: bool,
            scale: wp.vec2, centre: wp.vec2) -> bool:
    between = bool(False)  # a literal could not change inside the loop
    for step in range(SIGHT_STEPS):
        point = a + (b - a) * ((float(step) + 1.5) / float(SIGHT_STEPS + 2))
        at = project(point, perspective, scale, centre)
        r, c = int(wp.floor(at[1])), int(wp.floor(at[0]))
        if r >= 0 and c >= 0 and r < mask.shape[0] and c < mask.shape[1]:
            pixel = wp.where(perspective, -point[2], 1.0) / (0.5 * (scale[0] + scale[1]))
            if mask[r, c] != wp.uint8(0) and height[r, c] > point[2] + SIGHT_MARGIN_PIXELS * pixel:
                between = True
    return between


@wp.kernel(enable_backward=False, module="unique")
def _factor_kernel(first: int,
                   points: wp.array(dtype=wp.vec3),  # [n]
                   normals: wp.array(dtype=wp.vec3),  # [n]
                   areas: wp.array(dtype=float),  # [n]
                   height: wp.array2d(dtype=float),
                   mask: wp.array2d(dtype=wp.uint8),
                   perspective: bool,
                   scale: wp.vec2,
                   centre: wp.vec2,
                   # outputs
                   factors: wp.array2d(dtype=float)):  # [n, n]
    i = first + wp.tid()
    for j in range(points.shape[0]):
        way = points[j] - points[i]
        far = wp.length(way)
        value = float(0.0)  # likewise
        if j != i and far > 0.0:
            here = wp.max(wp.dot(normals[i], way) / far, 0.0)
            there = wp.max(-wp.dot(normals[j], way) / far, 0.0)
            value = here * there * areas[j] / (wp.pi * far * far + areas[j])
            if value > LEAST_FACTOR and _hidden(points[i], points[j], height, mask, perspective, scale, centre):
                value = 0.0
        factors[i, j] = value
