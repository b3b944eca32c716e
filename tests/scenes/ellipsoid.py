"""A tilted ellipsoid that stands free, and the hollow that it would press into the ground, under distant lights: Lambertian, with the
shadows that each casts on itself in closed form."""

import numpy as np

from tests.reference.sampling import lattice
from tests.scenes.captures import Scene, render

TILT = np.array([[1.0, 0.35, 0.2], [0.35, 1.5, -0.25], [0.2, -0.25, 1.2]])
"""The ellipsoid is xᵀ TILT x = 1: no axis of it is one of the camera, so that no mirroring maps it onto itself."""
NOISE = 0.003
"""Standard deviation of the noise, of the brightest value."""


def lights(count: int, largest_degrees: float = 60.0) -> np.ndarray:
    """[count, 3] unit directions spread over the cap about the view axis, in no order."""
    return lattice(count, largest_degrees)[np.random.default_rng(7).permutation(count)]


def ellipsoid(size: int = 72, count: int = 16, *, hollow: bool = False, largest_degrees: float = 60.0) -> Scene:
    """The object, or its hollow, with a texture and lights of different strength."""
    across = (np.arange(size) + 0.5) / size * 2.6 - 1.3
    x, y = np.meshgrid(across, -across)
    # TILT gives a z² + 2 h z + c = 0 along the line of sight
    a, h = TILT[2, 2], TILT[0, 2] * x + TILT[1, 2] * y
    c = TILT[0, 0] * x * x + 2 * TILT[0, 1] * x * y + TILT[1, 1] * y * y - 1
    root = h * h - a * c
    mask = root > 0.004  # pixels at the outline would be cut in half
    z = (-h + np.sqrt(np.maximum(root, 0))) / a
    point = np.stack([x, y, z], axis=-1)
    normal = point @ TILT
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(mask[..., None], normal, [0.0, 0.0, 1.0])
    if hollow:
        normal = normal * [-1.0, -1.0, 1.0]
    rng = np.random.default_rng(3)
    albedo = (0.45 + 0.2 * np.sin(5 * x + 1) * np.cos(7 * y) + 0.1 * rng.random(x.shape))[..., None] * [1.0, 0.8, 0.6] * mask[..., None]
    directions = lights(count, largest_degrees)
    irradiance = np.exp(0.35 * rng.normal(size=(count, 1))) * [1.0, 0.95, 0.9]
    images = render(normal, albedo, directions, irradiance)
    if hollow:
        images *= ~_shadow(point, directions)[..., None]
    images += NOISE * images.max() * rng.normal(size=images.shape)
    return Scene(normal, albedo, mask, directions, irradiance, np.maximum(images, 0))


def seen_from_near(size: int = 72, count: int = 16, distance: float = 4.0) -> tuple[Scene, dict]:
    """The object before a perspective camera, and the camera of its manifest."""
    across = ((np.arange(size) + 0.5) / size * 2 - 1) * 1.3 / distance
    ray = np.stack([*np.meshgrid(across, -across), np.full((size, size), -1.0)], axis=-1)
    start = np.array([0.0, 0.0, distance])
    a, h = np.einsum("rci,ij,rcj->rc", ray, TILT, ray), ray @ TILT @ start
    root = h * h - a * (start @ TILT @ start - 1)
    mask = root > 0.05
    way = (-h - np.sqrt(np.maximum(root, 0))) / a
    normal = (start + way[..., None] * ray) @ TILT
    normal = np.where(mask[..., None], normal / np.linalg.norm(normal, axis=-1, keepdims=True), [0.0, 0.0, 1.0])
    albedo, directions = np.full((size, size, 3), 0.5) * mask[..., None], lights(count)
    irradiance = np.ones((count, 3))
    focal = size / 2 / (1.3 / distance)
    camera = {"projection": "perspective", "resolution": [size, size], "focal_px": [focal, focal], "surface_z_m": -distance}
    return Scene(normal, albedo, mask, directions, irradiance, render(normal, albedo, directions, irradiance)), camera


def _shadow(point: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[lights, rows, cols] whether the way from a point of the hollow to the light meets the hollow again.

    The hollow is the object mirrored in z = 0: the far half of the mirrored ellipsoid, whose outward normals have z < 0.
    """
    start = point * [1.0, 1.0, -1.0]
    tilt = TILT * np.outer([1, 1, -1], [1, 1, -1])
    hidden = []
    for light in directions:
        along = -2 * (start @ tilt @ light) / (light @ tilt @ light)
        met = start + along[..., None] * light
        hidden.append((along > 1e-6) & (met @ tilt[2] < 0))
    return np.array(hidden)
