"""A ball rendered by ray casting in float64, slowly and independently: mirror and Lambertian, orthographic and perspective.

Camera frame: x right, y up, z towards the viewer. Image coordinates: u right, v down, pixel centres at + 0.5.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

Shade = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(point [n, 3], normal [n, 3], to viewer [n, 3]) → radiance [n]."""


def rays(u, v, *, width, height, pixel_size=None, focal=None):
    """Origin and direction of the rays through image points, [n, 3] each."""
    x, y = u - width / 2, height / 2 - v
    if focal is None:
        origin = np.stack([x * pixel_size, y * pixel_size, np.full_like(x, 10.0)], axis=-1)
        return origin, np.broadcast_to([0.0, 0.0, -1.0], origin.shape)
    way = np.stack([x / focal, y / focal, -np.ones_like(x)], axis=-1)
    return np.zeros_like(way), way / np.sqrt((way * way).sum(-1, keepdims=True))


class Hits(NamedTuple):
    """Where the rays of an image meet a ball."""

    hit: np.ndarray  # [rays] bool
    point: np.ndarray  # [hits, 3]
    normal: np.ndarray  # [hits, 3]
    viewer: np.ndarray  # [hits, 3]


@lru_cache(maxsize=2)  # the rays do not depend on the light, and tests look at one ball under many lights
def cast(centre, radius, width, height, samples, camera) -> Hits:
    """The rays through samples² places of each pixel, in rows of places."""
    steps = (np.arange(samples) + 0.5) / samples
    u, v = np.meshgrid((np.arange(width)[:, None] + steps).ravel(), (np.arange(height)[:, None] + steps).ravel())
    origin, way = rays(u.ravel(), v.ravel(), width=width, height=height, **dict(camera))
    offset = origin - np.array(centre)
    half_b, c = (offset * way).sum(-1), (offset * offset).sum(-1) - radius**2
    discriminant = half_b**2 - c
    hit = discriminant > 0
    distance = -half_b[hit] - np.sqrt(discriminant[hit])
    point = origin[hit] + distance[:, None] * way[hit]
    return Hits(hit, point, (point - centre) / radius, -way[hit])


def render(shade: Shade, *, centre, radius, width, height, samples=8, background=0.0, **camera):
    """Radiance [height, width] and coverage [height, width] of a ball, each pixel the mean of samples² rays."""
    hit, point, normal, viewer = cast(tuple(centre), radius, width, height, samples, tuple(camera.items()))
    value = np.full(hit.shape, background)
    value[hit] = shade(point, normal, viewer)

    def pooled(samples_of):
        return samples_of.reshape(height, samples, width, samples).mean(axis=(1, 3))

    return pooled(value), pooled(hit.astype(np.float64))


def mirror_of_far(direction, *, degrees=1.5, peak=1.0, floor=0.0):
    """A mirror that shows a far light: a Gaussian lobe of `degrees` about `direction`, over a dim surround."""
    def shade(point, normal, viewer):
        seen = 2 * (normal * viewer).sum(-1, keepdims=True) * normal - viewer
        return floor + peak * np.exp((seen @ direction - 1) / np.radians(degrees) ** 2)
    return shade


def mirror_of_near(position, *, degrees=1.5):
    """A mirror that shows a small near light, of `degrees` as seen from the ball."""
    def shade(point, normal, viewer):
        seen = 2 * (normal * viewer).sum(-1, keepdims=True) * normal - viewer
        toward = position - point
        toward = toward / np.sqrt((toward * toward).sum(-1, keepdims=True))
        return np.exp(((seen * toward).sum(-1) - 1) / np.radians(degrees) ** 2)
    return shade


def lambertian(direction, *, albedo=0.5, irradiance=1.0, highlight=0.0):
    """A grey ball under a far light, with a Phong highlight where asked."""
    def shade(point, normal, viewer):
        cosine = np.maximum(normal @ direction, 0)
        seen = 2 * (normal * viewer).sum(-1, keepdims=True) * normal - viewer
        return albedo / np.pi * irradiance * cosine + highlight * np.maximum(seen @ direction, 0) ** 50 * (cosine > 0)
    return shade


def lambertian_near(position, *, albedo=0.5, intensity=1.0, axis=None, anisotropy=0.0):
    """A grey ball under a point light of cosine lobe cos^anisotropy about `axis`."""
    def shade(point, normal, viewer):
        way = position - point
        distance = np.sqrt((way * way).sum(-1))
        lobe = 1.0 if axis is None else np.maximum(-(way @ axis) / distance, 0) ** anisotropy
        return albedo / np.pi * intensity * lobe * np.maximum((normal * way).sum(-1), 0) / distance**3
    return shade
