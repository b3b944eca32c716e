"""Squares of the image with their readings over those that normals and albedo predict, in which edges and texture are compared."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from service.solve.base.solution import SolveInput
from stage.capture.point_lights import DistantLights

SIDE, MOST_SQUARES = 32, 16
"""Pixels along a side, and the most squares that are looked at."""
LEAST_COSINE = 0.25
"""Least cosine between normal and light of readings that are compared: below, a small error of the normal makes a large one of them."""
LEAST_BRIGHT = 0.1
"""Least part that a pixel reflects of what the brightest of its square does, in each colour: of darker ones noise is most."""


class Square(NamedTuple):
    """Readings of a square."""

    place: np.ndarray  # [rows, cols] row-major positions in the image
    albedo: np.ndarray  # [rows, cols, 3] float32, median over the lights; 0 where it is not known
    ratio: np.ndarray  # [lights, rows, cols, 3] float32, readings over expected ones: about 1 where a pixel is lit, NaN where not known


def squares(given: SolveInput, lights: DistantLights, normal: np.ndarray, estimated: np.ndarray, *, most_lights: int) -> Iterator[Square]:
    """Yield squares that are spread over the object.

    Args:
        normal: [3, pixels] unit normals.
        estimated: [rows, cols] bool, pixels with one.
        most_lights: number of lights that are compared.
    """
    rows, cols = (max(1, length // SIDE) for length in estimated.shape)
    corners = [(SIDE * row, SIDE * col) for row in range(rows) for col in range(cols)]
    inside = [corner for corner in corners if 2 * estimated[corner[0] :, corner[1] :][:SIDE, :SIDE].sum() > SIDE * SIDE]
    chosen, (height, width) = evenly(len(lights.direction), most_lights), estimated.shape
    for row, col in (inside[number] for number in evenly(len(inside), MOST_SQUARES)):
        place = np.arange(row, min(row + SIDE, height))[:, None] * width + np.arange(col, min(col + SIDE, width))
        pixels = place.reshape(-1)
        radiance, usable = given.stack.pick_radiance(pixels)
        cosine = lights.direction[chosen] @ normal[:, pixels].astype(np.float64)
        known = usable[chosen] & (cosine > LEAST_COSINE) & estimated.reshape(-1)[pixels]
        expected = lights.irradiance[chosen][:, None] * np.maximum(cosine, LEAST_COSINE)[..., None]
        albedo = np.where(known[..., None], radiance[chosen] / expected, np.inf).astype(np.float32)
        median = np.take_along_axis(np.sort(albedo, axis=0), (known.sum(axis=0) // 2)[None, :, None], axis=0)[0]  # lit, where most are
        told = np.isfinite(median) & (median > 0)
        told &= median > LEAST_BRIGHT * np.max(median, axis=0, where=told, initial=0)
        ratio = np.where(known[..., None] & told, albedo, np.nan) / np.where(told, median, 1)
        yield Square(place, np.where(told, median, 0).reshape(*place.shape, 3), ratio.reshape(-1, *place.shape, 3))
