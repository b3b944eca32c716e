"""Find the triangle of a mesh that covers each texel of its texture."""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy

EDGE = 1.0e-5
"""The largest distance of a texel outside of a triangle, in barycentric coordinates, so that none is missed between two triangles."""


@wp.func
def _cross(a: wp.vec2, b: wp.vec2) -> float:
    return a[0] * b[1] - a[1] * b[0]


@wp.kernel(enable_backward=False)
def _rasterise_kernel(first: int, texture: wp.array(dtype=wp.vec2), faces: wp.array2d(dtype=int), rows: int, cols: int,
                      # outputs
                      covered: wp.array2d(dtype=int)):
    i = first + wp.tid()
    a = texture[faces[i, 0]]
    b = texture[faces[i, 1]]
    c = texture[faces[i, 2]]
    area = _cross(b - a, c - a)
    if area != 0.0:
        left = wp.max(int(wp.floor(wp.min(wp.min(a[0], b[0]), c[0]))), 0)
        right = wp.min(int(wp.ceil(wp.max(wp.max(a[0], b[0]), c[0]))), cols)
        top = wp.max(int(wp.floor(wp.min(wp.min(a[1], b[1]), c[1]))), 0)
        bottom = wp.min(int(wp.ceil(wp.max(wp.max(a[1], b[1]), c[1]))), rows)
        for row in range(top, bottom):
            for col in range(left, right):
                p = wp.vec2(float(col) + 0.5, float(row) + 0.5)
                wa = _cross(b - p, c - p) / area
                wb = _cross(c - p, a - p) / area
                if wp.min(wp.min(wa, wb), 1.0 - wa - wb) >= -EDGE:
                    wp.atomic_max(covered, row, col, i)


def rasterise(texture: np.ndarray, faces: np.ndarray, rows: int, cols: int, *, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Find the triangle of each texel whose centre one covers; waits for the device.

    Args:
        texture: [V, 2] u and v of the vertices in texels, from the top-left corner of the image.
        faces: [F, 3] vertex numbers.

    Returns:
        [rows, cols] int32, the face with the largest number that covers the centre, −1 where none does; and [n, 3] float64, the barycentric
        coordinates of the covered texels in row-major order.
    """
    covered: Any = wp.full((rows, cols), -1, dtype=int, device=device)
    devices.launch(_rasterise_kernel, len(faces), [wp.array(texture.astype(np.float32), dtype=wp.vec2, device=device),
                                                   wp.array(faces.astype(np.int32), dtype=int, device=device), rows, cols], [covered],
                   device=device, uneven=True)
    found = to_numpy(covered)
    row, col = np.nonzero(found >= 0)
    a, b, c = (texture[faces[found[row, col], corner]].astype(np.float64) for corner in range(3))
    p = np.stack([col + 0.5, row + 0.5], axis=-1)

    def cross(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0])

    area = cross(b - a, c - a)
    first, second = cross(b - p, c - p) / area, cross(c - p, a - p) / area
    return found, np.stack([first, second, 1 - first - second], axis=-1)
