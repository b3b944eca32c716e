"""A dome with a horn that hides wide sources from the pixels around it, rendered in float64 by following lines over the heights.

Nothing here leans on the code that it judges.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.reference import sampling as twin
from tests.scenes.captures import write_lit

RIM, ALBEDO, SHARPNESS = 0.95, 0.3, 6.0
STEPS, LATTICE = 64, 1000
"""Places on each line, and directions over the sphere: 6.4 degrees apart."""


class Horn(NamedTuple):
    """What an orthographic camera sees, in units of the mask's radius over RIM."""

    points: np.ndarray  # [rows, cols, 3] float64
    normal: np.ndarray  # [rows, cols, 3]
    mask: np.ndarray  # [rows, cols] bool
    camera: dict[str, Any]


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    away = (x - 0.15) ** 2 + (y - 0.1) ** 2
    return 0.5 * np.sqrt(np.maximum(1.3 - x**2 - y**2, 0.05)) + 0.55 * np.exp(-((away / 0.03) ** 1.5))


def horn(size: int) -> Horn:
    u = (np.arange(size) + 0.5 - size / 2) / (size / 2)
    x, y = np.meshgrid(u, -u)
    step = 1e-4
    normal = np.stack([height(x - step, y) - height(x + step, y), height(x, y - step) - height(x, y + step),
                       np.full_like(x, 2 * step)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    camera = {"projection": "orthographic", "resolution": [size, size], "pixel_size_m": float(u[1] - u[0])}
    return Horn(np.stack([x, y, height(x, y)], axis=-1), normal, x**2 + y**2 < RIM**2, camera)


def cosines(scene: Horn, directions: np.ndarray) -> np.ndarray:
    """[pixels of the mask, directions] n·l, 0 where the surface hides the direction."""
    points, normal = scene.points[scene.mask], scene.normal[scene.mask]
    top = points[:, 2].max()
    result = np.maximum(normal @ directions.T, 0)
    for index, way in enumerate(directions):
        lit = np.flatnonzero(result[:, index])
        reach = np.minimum((top - points[lit, 2]) / max(way[2], 1e-6), 3.0) if way[2] > 0 else np.full(len(lit), 3.0)
        along = points[lit, None] + way * (reach[:, None] * (np.arange(STEPS) + 0.5) / STEPS)[..., None]
        over = (height(along[..., 0], along[..., 1]) > along[..., 2] + 2e-3) & (along[..., 0] ** 2 + along[..., 1] ** 2 < RIM**2)
        result[lit[over.any(axis=1)], index] = 0
    return result


def write(folder: Path, scene: Horn, sources: int) -> Path:
    """A capture under sources spread over the sphere. The albedo is low: light from surface to surface is left out."""
    directions = twin.lattice(LATTICE)
    told = np.round(directions / np.linalg.norm(directions, axis=1, keepdims=True), 9)
    seen, steradians = cosines(scene, directions), 4 * np.pi / LATTICE
    images, lights = np.zeros((sources, *scene.mask.shape, 3)), []
    for image, centre in zip(images, twin.lattice(sources), strict=True):
        radiance = np.exp(SHARPNESS * (directions @ centre - 1))
        lit = radiance > 0.02
        image[scene.mask] = (ALBEDO / np.pi * seen[:, lit] @ radiance[lit] * steradians)[:, None]
        lights.append({"type": "extended", "directions": told[lit].tolist(), "radiance": np.repeat(radiance[lit, None], 3, axis=1).tolist(),
                       "solid_angle": [steradians] * int(lit.sum())})
    return write_lit(folder, images, lights, camera=scene.camera, mask=scene.mask, name="horn")
