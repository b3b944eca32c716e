"""Normals of a depth map, from the plane that fits the neighbourhood of each pixel.

Along the lines of sight (x, y, -1) of a perspective camera the inverse depth of the plane n·p = c is (n_x x + n_y y - n_z) / c: linear
in x and y. The plane is therefore a linear least-squares fit of the inverse depth over the neighbours, exact for every plane. Under an
orthographic camera the depth of the plane is linear in x and y.
"""

import numpy as np

from stage.capture.camera import Camera
from stage.results.depth_breaks import SIDE, connected

LEAST_NEIGHBOURS = 3
"""The least number of neighbours, without the pixel itself, that a plane is fitted to."""
LEAST_SPREAD = 1e-3
"""The least relative spread of the neighbours across their main direction: points on one line determine no plane."""
ROWS = 256
"""The number of rows that are fitted at one time, which bounds the memory."""


def depth_normals(depth: np.ndarray, mask: np.ndarray, camera: Camera, *, sigma: np.ndarray | None = None,
                  radius: int = 1) -> np.ndarray:
    """Return the normal of the plane through each pixel and its neighbours on the same surface.
    Returns [rows, cols, 3] float32, unit, camera frame, towards the camera; 0 where the neighbours determine no plane.

    Args:
        depth: [rows, cols] metres.
        mask: [rows, cols] bool, True where there is a depth.
        sigma: [rows, cols] metres, standard deviation of the depth, by which noise is told from a break; None: there is no noise.
        radius: the radius of the neighbourhood in pixels; 1 is 3×3 pixels.
    """
    halo = radius * SIDE
    x, y = camera.plane_coordinates()
    normal = np.zeros((*depth.shape, 3), dtype=np.float32)
    box = bounds(mask)
    for top in range(box[0].start, box[0].stop, ROWS):
        bottom = min(top + ROWS, box[0].stop)
        part = slice(max(top - halo, 0), min(bottom + halo, depth.shape[0])), box[1]
        normal[top:bottom, box[1]] = _fit(depth[part], mask[part], x[part], y[part], camera, None if sigma is None else sigma[part],
                                          radius)[top - part[0].start:bottom - part[0].start]
    return normal


def bounds(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest box around all pixels of a mask; both empty where there is none."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)) if len(rows) else (slice(0, 0), slice(0, 0))


def _fit(depth: np.ndarray, mask: np.ndarray, x: np.ndarray, y: np.ndarray, camera: Camera,
         sigma: np.ndarray | None, radius: int) -> np.ndarray:
    """Return the normals of a range of rows, the outermost of which lack neighbours."""
    depth = np.where(mask, depth, 1.0).astype(np.float64)
    perspective = camera.projection == "perspective"
    inverse = 1 / depth if perspective else depth
    count = mask.astype(np.float64)
    sums = {name: np.zeros(depth.shape) for name in ("x", "y", "i", "xx", "xy", "yy", "xi", "yi")}
    height, width = depth.shape
    for down in range(radius + 1):
        for right in range(-radius if down else 1, radius + 1):
            if down >= height or abs(right) >= width:
                continue
            here = slice(0, height - down), slice(max(-right, 0), width - max(right, 0))
            there = slice(down, height), slice(max(right, 0), width - max(-right, 0))
            one = connected(depth, mask, camera, (down, right), sigma=sigma)[here]
            dx, dy, di = (one * (plane[there] - plane[here]) for plane in (x, y, inverse))
            for pixel in (here, there):  # each is a neighbour of the other
                count[pixel] += one
            for name, value, sign in (("x", dx, -1), ("y", dy, -1), ("i", di, -1), ("xx", dx * dx, 1), ("xy", dx * dy, 1),
                                      ("yy", dy * dy, 1), ("xi", dx * di, 1), ("yi", dy * di, 1)):
                sums[name][here] += value
                sums[name][there] += sign * value
    n = np.maximum(count, 1)
    mean_x, mean_y, mean_i = sums["x"] / n, sums["y"] / n, sums["i"] / n
    xx, xy, yy = sums["xx"] / n - mean_x**2, sums["xy"] / n - mean_x * mean_y, sums["yy"] / n - mean_y**2
    xi, yi = sums["xi"] / n - mean_x * mean_i, sums["yi"] / n - mean_y * mean_i
    det = xx * yy - xy * xy
    good = mask & (count > LEAST_NEIGHBOURS) & (det > LEAST_SPREAD * ((xx + yy) / 2) ** 2)
    det = np.where(good, det, 1)
    across, up = (xi * yy - yi * xy) / det, (yi * xx - xi * xy) / det
    toward = across * x + up * y - (inverse + mean_i - across * mean_x - up * mean_y)  # -n_z/c from the fit at the pixel
    normal = np.stack([-across, -up, -toward] if perspective else [across, up, np.ones_like(up)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(good[..., None], normal, 0).astype(np.float32)
