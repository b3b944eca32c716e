"""Captures of spheres under diffused sources with a known truth, rendered by the float64 twin."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.reference import sampling as twin
from tests.scenes.captures import write_lit

SHARPNESS = 6.0
VIEW = np.array([0.0, 0.0, 1.0])
LIMIT = 0.96
"""Radius of the mask over that of the sphere: normals up to 74° from the view."""
COLOUR = np.array([1.0, 0.8, 0.6])
"""Of every source."""


class Ball(NamedTuple):
    """A sphere in the middle of a square image."""

    normal: np.ndarray  # [side, side, 3] float64
    mask: np.ndarray  # [side, side] bool


def ball(side: int) -> Ball:
    centre = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(centre * LIMIT, -centre * LIMIT)
    mask = x**2 + y**2 < LIMIT**2
    x, y = np.where(mask, x, 0), np.where(mask, y, 0)
    return Ball(np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=-1), mask)


def light(centre: np.ndarray, *, count: int = 1500, colour: np.ndarray = COLOUR) -> dict[str, Any]:
    """One source as the manifest holds it."""
    direction, value, steradians = twin.samples_of(centre, SHARPNESS, count=count)
    return {"type": "extended", "directions": np.round(direction / np.linalg.norm(direction, axis=1, keepdims=True), 9).tolist(),
            "radiance": (value[:, None] * colour).tolist(), "solid_angle": [steradians] * len(value)}


def write_sampling(folder: Path, scene: Ball, radiance: np.ndarray, centres: np.ndarray, *, lights: list[dict] | None = None,
                   **changes: Any) -> Path:
    """Write a capture of the masked pixels' radiance [n, lights, 3]."""
    lights = lights or [light(centre) for centre in centres]
    images = np.zeros((len(lights), *scene.mask.shape, 3))
    images[:, scene.mask] = np.moveaxis(radiance, 1, 0)
    rows, cols = scene.mask.shape
    return write_lit(folder, images, lights, mask=scene.mask, **{
        "name": "ball", "camera": {"projection": "orthographic", "resolution": [cols, rows]}, **changes})
