"""Diffused sources around the object, as the twin renders them and as the tables take them."""

import numpy as np
import warp as wp

from kernels import packs
from kernels.photometric.lambertian.readings import grey_factors, pad_lights
from kernels.photometric.model.response_table import response_table
from kernels.photometric.model.samples import Samples, gather
from tests.kernels.scenes import GREY, store
from tests.reference import sampling as twin

SHARPNESS = 6.0
"""κ of every source: radiance falls to a half 28° from the middle."""
LIGHTS = 20
CENTRES = twin.lattice(LIGHTS)
VIEW = np.array([0.0, 0.0, 1.0])


def table_of(device: str, *, count: int = 2500, turn: np.ndarray | None = None, sharpness: float = SHARPNESS) -> wp.array:
    """The response table of the sources, from samples on an even lattice of `count` directions of the sphere."""
    parts = [twin.samples_of(centre, sharpness, count=count) for centre in CENTRES]
    direction = np.concatenate([part[0] for part in parts])
    return response_table(direction if turn is None else direction @ turn.T,
                          np.concatenate([np.full(len(part[1]), part[2]) for part in parts]),
                          np.repeat(np.arange(LIGHTS), [len(part[1]) for part in parts]),
                          np.concatenate([part[1] / part[1].sum() for part in parts]), light_count=LIGHTS, device=device)


def sphere(side: int, limit: float = 0.97) -> np.ndarray:
    """[n, 3]: the normals of a sphere in a square image, without its very rim."""
    centre = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(centre, -centre)
    inside = x**2 + y**2 < limit**2
    return np.stack([x[inside], y[inside], np.sqrt(1 - x[inside] ** 2 - y[inside] ** 2)], axis=1)


def readings_of(radiance: np.ndarray, device: str, *, view: np.ndarray = VIEW, sharpness: float = SHARPNESS) -> Samples:
    """Samples of pixels [n, lights] or [n, lights, 3], stored as half."""
    radiance = radiance if radiance.ndim == 3 else np.repeat(radiance[..., None], 3, axis=2)
    count = len(radiance)
    lights = pad_lights(np.tile(VIEW, (LIGHTS, 1)), np.full((LIGHTS, 3), twin.irradiance(sharpness)))
    band = packs.upload(store(np.moveaxis(radiance, (2, 1, 0), (0, 1, 2))), device=device)
    return gather(band, np.arange(count), np.broadcast_to(view, (count, 3)), lights, grey_factors(lights, GREY), LIGHTS)
