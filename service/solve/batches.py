"""Pixels of an image as samples, as many at a time as memory allows: what every solver that works hard per pixel walks over."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from kernels import packs
from kernels.photometric.near import NearField
from kernels.photometric.readings import Lights
from kernels.photometric.samples import Samples, gather
from service.solve.solution import READING_BYTES
from stage.camera import Camera
from stage.stack import Stack

SAMPLE_FLOATS = 7
"""Per light and pixel of the samples: grey and colour readings, direction."""
BATCH_BYTES = 256 << 20
"""Of samples and lobes that are worked on at one time."""

View = Callable[[np.ndarray], np.ndarray]
"""From pixel positions (row-major, [n]) to unit directions to the viewer [n, 3] float32."""


class Batch(NamedTuple):
    """Some pixels."""

    where: np.ndarray  # [n] positions in the image
    samples: Samples


def pixel_batches(stack: Stack, lights: Lights, factors: np.ndarray, view: View, pixels: np.ndarray, device: str, *,
                  lobes: int, field: NearField | None = None) -> Iterator[Batch]:
    """Gather pixels of a stack, batch by batch.

    Args:
        stack: the images.
        lights: of the stack, padded.
        factors: of readings.grey_factors.
        view: of the camera.
        pixels: [n] positions, ascending.
        device: where.
        lobes: values that the search keeps for each light and pixel.
        field: where the lights are, where some light is near.
    """
    size = max(1, BATCH_BYTES // (4 * (SAMPLE_FLOATS + lobes) * stack.light_count))
    for start, stop in stack.bands(READING_BYTES * stack.shape[1]):
        local = pixels[(pixels >= start) & (pixels < stop)] - start
        if not len(local):
            continue
        band = packs.upload(stack.band(start, stop), stack.saturated(start, stop), device=device)
        for first in range(0, len(local), size):
            part = local[first : first + size]
            where = start + part
            yield Batch(where, gather(band, part, view(where), lights, factors, stack.light_count,
                                      None if field is None else field.at(where)))


def view_directions(camera: Camera) -> View:
    """Where the viewer is from each pixel."""
    if camera.projection == "orthographic":
        return lambda positions: np.tile(np.array([0, 0, 1], dtype=np.float32), (len(positions), 1))
    x, y = (plane.reshape(-1) for plane in camera.plane_coordinates())

    def towards(positions: np.ndarray) -> np.ndarray:
        rays = np.stack([-x[positions], -y[positions], np.ones(len(positions))], axis=1)
        return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)

    return towards
