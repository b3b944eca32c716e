"""Normals of a depth map, from the plane that fits the neighbourhood of each pixel.

Along the lines of sight (x, y, -1) of a perspective camera the inverse depth of the plane n·p = c is (n_x x + n_y y - n_z) / c: linear
in x and y. The plane is therefore a linear least-squares fit of the inverse depth over the neighbours, exact for every plane.
"""

import numpy as np

from stage.camera import Camera

STEEPEST = 5.67
"""The tangent of 80°: where depth changes faster between two neighbouring pixels, they are taken to show two surfaces."""
LEAST_NEIGHBOURS = 3
"""The least number of neighbours, without the pixel itself, that a plane is fitted to."""
LEAST_SPREAD = 1e-3
"""The least relative spread of the neighbours across their main direction: points on one line determine no plane."""
ROWS = 256
"""The number of rows that are fitted at one time, which bounds the memory."""


def same_surface(first: np.ndarray, second: np.ndarray, distance_px: float, camera: Camera) -> np.ndarray:
    """Return whether two depths can lie on one surface that is not steeper than 80 degrees.

    Args:
        first, second: depths in metres, of one shape; their order does not matter.
        distance_px: the distance between their two pixels, in pixels.
        camera: a perspective or orthographic camera.

    Returns:
        bool in the shape of the depths.
    """
    if camera.focal_px is None:
        return np.asarray(np.abs(first - second) <= STEEPEST * (camera.pixel_size_m or 1.0) * distance_px)
    footprint = np.minimum(first, second) / min(camera.focal_px)
    return np.asarray(np.abs(first - second) <= STEEPEST * footprint * distance_px)


def depth_normals(depth: np.ndarray, mask: np.ndarray, camera: Camera, *, radius: int = 1) -> np.ndarray:
    """Return the normal of the plane through each pixel and its neighbours on the same surface.

    Args:
        depth: [rows, cols] metres.
        mask: [rows, cols] bool, True where there is a depth.
        camera: a perspective camera.
        radius: the radius of the neighbourhood in pixels; 1 is 3×3 pixels.

    Returns:
        [rows, cols, 3] float32, unit, camera frame, towards the camera; 0 where the neighbours determine no plane.
    """
    x, y = camera.plane_coordinates()
    normal = np.zeros((*depth.shape, 3), dtype=np.float32)
    for top in range(0, depth.shape[0], ROWS):
        rows = slice(max(top - radius, 0), min(top + ROWS + radius, depth.shape[0]))
        inner = slice(top - rows.start, min(top + ROWS, depth.shape[0]) - rows.start)
        normal[top:top + ROWS] = _fit(depth[rows], mask[rows], x[rows], y[rows], camera, radius)[inner]
    return normal


def _fit(depth: np.ndarray, mask: np.ndarray, x: np.ndarray, y: np.ndarray, camera: Camera, radius: int) -> np.ndarray:
    """Return the normals of a range of rows, the outermost of which lack neighbours."""
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
