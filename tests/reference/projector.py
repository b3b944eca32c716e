"""Float64 twin for projected light: pinhole devices with Brown-Conrady lenses, run forwards by closed form and backwards by bisection;
imports nothing of ours.

Camera frame: x right, y up, z towards the viewer; image coordinates from the top-left corner.
"""

from typing import NamedTuple

import numpy as np

FLIP = np.diag([1.0, -1.0, -1.0])
"""x right, y down, z forward, from x right, y up, z backward; its own inverse."""


class Device(NamedTuple):
    """A camera or a projector."""

    width: int
    height: int
    focal: float
    k: tuple[float, float, float] = (0.0, 0.0, 0.0)
    p: tuple[float, float] = (0.0, 0.0)

    @property
    def principal(self):
        return np.array([self.width / 2 + 3.2, self.height / 2 - 1.7])


def distort(device, x, y):
    k1, k2, k3 = device.k
    p1, p2 = device.p
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y


def project(device, points):
    """[..., 2] image coordinates of points [..., 3] in the device's own frame (y up, z backward)."""
    x, y = points[..., 0] / -points[..., 2], points[..., 1] / points[..., 2]
    x, y = distort(device, x, y)
    return np.stack([x, y], axis=-1) * device.focal + device.principal


def rays(device, uv):
    """[..., 3] directions (x, y, -1) of image coordinates, the lens undone by Newton with a numeric Jacobian."""
    target = (uv - device.principal) / device.focal
    ideal, step = target.copy(), 1e-6
    for _ in range(8):
        x, y = ideal[..., 0], ideal[..., 1]
        here = np.stack(distort(device, x, y), axis=-1)
        along_x = (np.stack(distort(device, x + step, y), axis=-1) - here) / step
        along_y = (np.stack(distort(device, x, y + step), axis=-1) - here) / step
        off = target - here
        det = along_x[..., 0] * along_y[..., 1] - along_y[..., 0] * along_x[..., 1]
        ideal[..., 0] += (off[..., 0] * along_y[..., 1] - off[..., 1] * along_y[..., 0]) / det
        ideal[..., 1] += (off[..., 1] * along_x[..., 0] - off[..., 0] * along_x[..., 1]) / det
    return np.stack([ideal[..., 0], -ideal[..., 1], -np.ones_like(ideal[..., 0])], axis=-1)


def pixel_rays(device):
    """[rows, cols, 3] of every pixel centre."""
    u, v = np.meshgrid(np.arange(device.width) + 0.5, np.arange(device.height) + 0.5)
    return rays(device, np.stack([u, v], axis=-1))


def look_at(origin, target):
    """camera_from_device [4, 4] of a device at `origin` that looks at `target`, its x axis level."""
    back = np.array(origin, float) - target
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    matrix[:3, 3] = origin
    return matrix


def seen_by(projector, camera_from_projector, points):
    """[..., 2] projector coordinates of camera-frame points."""
    own = (points - camera_from_projector[:3, 3]) @ camera_from_projector[:3, :3]
    return project(projector, own)


def depth_of(direction, coordinate, axis, projector, camera_from_projector, near, far):
    """Depth along one line of sight at which the projector's coordinate is the given one, by bisection; it must be monotonous."""
    def off(depth):
        return seen_by(projector, camera_from_projector, direction * depth)[axis] - coordinate

    low, high = near, far
    sign = np.sign(off(low))
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if np.sign(off(middle)) == sign else (low, middle)
    return (low + high) / 2


def plane_depth(directions, point, normal):
    """[...] depth of a plane along lines of sight (x, y, -1)."""
    return np.dot(point, normal) / (directions @ np.asarray(normal, float))


def sphere_depth(directions, centre, radius):
    """[...] depth of the near side of a sphere, NaN beside it."""
    a = (directions**2).sum(axis=-1)
    b = directions @ np.asarray(centre, float)
    c = np.dot(centre, centre) - radius**2
    with np.errstate(invalid="ignore"):
        return (b - np.sqrt(b**2 - a * c)) / a
