"""An ellipse of a bright texture before a background, with the exact share of every pixel that it covers, ray cast in float64 on a grid of
many rays to a pixel."""

from typing import NamedTuple

import numpy as np

from tests.reference.sampling import lattice
from tests.scenes.captures import distant, write_lit

RAYS = 8
"""Rays along each side of a pixel: the coverage is exact to 1/64."""
NOISE = 0.003
"""Standard deviation of the noise that is added, of radiance: half a percent of the bright texture."""


class Covered(NamedTuple):
    """What was rendered."""

    coverage: np.ndarray  # [size, size] float64, 0…1
    directions: np.ndarray  # [lights, 3] float64, unit, from the surface to the light
    images: np.ndarray  # [lights, size, size, 3] float64, radiance under irradiance pi, with the background
    object: np.ndarray  # [lights, size, size, 3] float64, the same without the background: premultiplied


def render_covered(size: int = 48, lights: int = 24, *, radii: tuple[float, float] = (0.75, 0.45), lowest: float = -0.3,
                   background: float = 0.0, hole: float = 0.0) -> Covered:
    """Return an ellipsoid, matt with a weak lobe, turned in the image.

    Args:
        size: of the image, pixels.
        lights: spread over the sphere above z = `lowest`, evenly by golden angles.
        radii: of the outline, half an image.
        lowest: z of the lowest light.
        background: reflectance of a wall behind, on which the ellipsoid throws shadows that move with the light; 0 is black.
        hole: radius of a round hole in the middle, half an image.
    """
    directions = lattice(lights, np.degrees(np.arccos(lowest)))
    centre = (np.arange(size * RAYS) + 0.5) / (size * RAYS) * 2 - 1
    x, y = np.meshgrid(centre, -centre)
    cosine, sine = np.cos(0.4), np.sin(0.4)

    def outline(x, y):
        return (x * cosine + y * sine) / radii[0], (y * cosine - x * sine) / radii[1]

    u, v = outline(x, y)
    hit = (u * u + v * v < 1) & (x * x + y * y > hole * hole)
    depth = np.sqrt(np.maximum(1 - u * u - v * v, 0))
    gradient = u / radii[0], v / radii[1]
    across, up = gradient[0] * cosine - gradient[1] * sine, gradient[0] * sine + gradient[1] * cosine
    normal = np.stack([across, up, depth / np.mean(radii)], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    albedo = np.stack([0.5 + 0.3 * np.sin(9 * x + 3 * y), 0.4 + 0.25 * np.cos(7 * y), 0.35 + 0.2 * np.sin(11 * (x - y))], axis=-1)

    def pixels(values):
        return values.reshape(size, RAYS, size, RAYS, -1).mean(axis=(1, 3))

    images, alone = [], []
    for direction in directions:
        lit = np.maximum(normal @ direction, 0)[..., None]
        half = (direction + (0, 0, 1)) / np.linalg.norm(direction + (0, 0, 1))
        lobe = 0.05 / (0.02 + 1 - np.minimum(normal @ half, 1))[..., None] ** 2 * 0.02
        radiance = pixels((albedo + lobe) * lit * hit[..., None])
        wall = background * max(direction[2], 0)
        shadow = outline(x + 0.25 * direction[0], y + 0.25 * direction[1])
        behind = np.where(shadow[0] ** 2 + shadow[1] ** 2 < 1, 0.05 * wall, wall) * ~hit
        alone.append(radiance)
        images.append(radiance + pixels(behind))
    return Covered(pixels(hit.astype(np.float64))[..., 0], directions, np.array(images), np.array(alone))


def write_covered(folder, scene: Covered, mask, *, cut=False):
    """Write a capture of a rendered outline with noise; `mask` is bool, or coverage; `cut`: black outside."""
    noise = np.random.default_rng(2).normal(0, NOISE, scene.images.shape)
    images = np.maximum(scene.images + noise, 0) * (mask[..., None] if cut else 1)
    return write_lit(folder, images, [distant(direction, np.pi) for direction in scene.directions], mask=mask,
                     camera={"projection": "orthographic", "resolution": list(mask.shape)})
