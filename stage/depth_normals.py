"""Normals of a depth map: at each pixel the plane that fits its neighbourhood.

Along the lines of sight (x, y, -1) of a perspective camera the inverse depth of the plane n·p = c is (n_x x + n_y y - n_z) / c: linear
in x and y. So the plane is a least-squares fit of the inverse depth over the neighbours, exact for planes at any tilt and distance.
"""

import numpy as np

from stage.camera import Camera

STEEPEST = 5.67
"""Tangent of 80°: a surface that recedes faster between two neighbouring pixels is taken to be two surfaces."""
LEAST_NEIGHBOURS = 3
"""Beside the pixel itself, for a plane."""
LEAST_SPREAD = 1e-3
"""Of the neighbours' places across their main direction, relative: on one line there is no plane."""
ROWS = 256
"""Rows that are worked on at one time: bounds the memory."""


def same_surface(near: np.ndarray, far: np.ndarray, distance_px: float, camera: Camera) -> np.ndarray:
    """Whether two depths so many pixels apart can lie on one surface that is not steeper than 80 degrees.

    Args:
        near, far: depths, metres, of one shape; their order does not matter.
        distance_px: between their pixels.
        camera: of either projection.
    """
    if camera.focal_px is None:
        return np.asarray(np.abs(near - far) <= STEEPEST * (camera.pixel_size_m or 1.0) * distance_px)
    footprint = np.minimum(near, far) / min(camera.focal_px)
    return np.asarray(np.abs(near - far) <= STEEPEST * footprint * distance_px)


def depth_normals(depth: np.ndarray, mask: np.ndarray, camera: Camera, *, radius: int = 1) -> np.ndarray:
    """Fit a plane to each pixel and its neighbours on the same surface.

    Args:
        depth: [rows, cols] metres.
        mask: [rows, cols] bool, where there is a depth.
        camera: perspective.
        radius: of the neighbourhood, pixels: 1 is 3×3.

    Returns:
        [rows, cols, 3] float32, unit, camera frame, towards the camera; 0 where the neighbours do not span a plane.
    """
    x, y = camera.plane_coordinates()
    normal = np.zeros((*depth.shape, 3), dtype=np.float32)
    for top in range(0, depth.shape[0], ROWS):
        rows = slice(max(top - radius, 0), min(top + ROWS + radius, depth.shape[0]))
        inner = slice(top - rows.start, min(top + ROWS, depth.shape[0]) - rows.start)
        normal[top:top + ROWS] = _fit(depth[rows], mask[rows], x[rows], y[rows], camera, radius)[inner]
    return normal


def _fit(depth: np.ndarray, mask: np.ndarray, x: np.ndarray, y: np.ndarray, camera: Camera, radius: int) -> np.ndarray:
    """The same for a few rows, whose outer ones lack neighbours."""
    depth = np.where(mask, depth, 1.0).astype(np.float64)
    inverse = 1 / depth
    count = mask.astype(np.float64)
    sums = {name: np.zeros(depth.shape) for name in ("x", "y", "i", "xx", "xy", "yy", "xi", "yi")}
    height, width = depth.shape
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            if (down, right) == (0, 0) or abs(down) >= height or abs(right) >= width:
                continue
            here = slice(max(-down, 0), height - max(down, 0)), slice(max(-right, 0), width - max(right, 0))
            there = slice(max(down, 0), height - max(-down, 0)), slice(max(right, 0), width - max(-right, 0))
            one = same_surface(depth[here], depth[there], float(np.hypot(down, right)), camera) & mask[here] & mask[there]
            dx, dy, di = (plane[there] - plane[here] for plane in (x, y, inverse))
            count[here] += one
            for name, value in (("x", dx), ("y", dy), ("i", di), ("xx", dx * dx), ("xy", dx * dy), ("yy", dy * dy),
                                ("xi", dx * di), ("yi", dy * di)):
                sums[name][here] += one * value
    n = np.maximum(count, 1)
    mean_x, mean_y, mean_i = sums["x"] / n, sums["y"] / n, sums["i"] / n
    xx, xy, yy = sums["xx"] / n - mean_x**2, sums["xy"] / n - mean_x * mean_y, sums["yy"] / n - mean_y**2
    xi, yi = sums["xi"] / n - mean_x * mean_i, sums["yi"] / n - mean_y * mean_i
    det = xx * yy - xy * xy
    good = mask & (count > LEAST_NEIGHBOURS) & (det > LEAST_SPREAD * ((xx + yy) / 2) ** 2)
    det = np.where(good, det, 1)
    across, up = (xi * yy - yi * xy) / det, (yi * xx - xi * xy) / det
    toward = across * x + up * y - (inverse + mean_i - across * mean_x - up * mean_y)  # -n_z/c from the fit at the pixel
    normal = np.stack([-across, -up, -toward], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(good[..., None], normal, 0).astype(np.float32)
