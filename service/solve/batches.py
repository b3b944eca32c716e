"""The pixels of an image as readings on the device, as many at a time as memory allows."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from kernels import packs
from kernels.photometric.near import NearField, NearLights, see_near
from kernels.photometric.readings import Lights, Readings, grey_factors, grey_readings
from kernels.photometric.samples import Samples, gather
from kernels.status import Status
from service.solve.several_devices import deal
from service.solve.solution import SolveInput
from stage.camera import Camera
from stage.colour import GREY_WEIGHTS
from stage.stack import PIXEL_PAD, Stack

READING_BYTES = 4
"""A grey reading, per light and pixel, beside the stack's band."""
NEAR_BYTES = READING_BYTES + 16
"""The same where lights are near: with a direction and a falloff."""
SAMPLE_FLOATS = 7
"""Numbers per light and pixel of the samples: grey and colour readings, direction."""
BATCH_BYTES = 256 << 20
"""Memory for the samples and lobes that are worked on at one time."""
LEAST_READINGS = 3
"""Frames with a reading, dark or not, that a normal needs."""

View = Callable[[np.ndarray], np.ndarray]
"""From pixel positions (row-major, [n]) to unit directions to the viewer [n, 3] float32."""


class ReadBand(NamedTuple):
    """A band of the image with its readings on the device."""

    span: slice
    """Its pixels, as row-major positions in the image."""
    inside: np.ndarray  # [n] bool: which of these pixels are inside the mask
    band: packs.Band
    readings: Readings
    near: NearLights | None
    """Direction and falloff of each light at each pixel, where some light is near."""


class Batch(NamedTuple):
    """Chosen pixels with their readings on the device."""

    pixels: np.ndarray  # [n] row-major positions in the image
    samples: Samples


def each_span(given: SolveInput, bytes_per_pixel: int, work: Callable[[int, int, str], None]) -> None:
    """Do the pixel ranges of the image that touch the mask on the devices, and say how far it is.

    Args:
        given: the images.
        bytes_per_pixel: what the work allocates for each pixel beside the stack.
        work: takes the range's first pixel, the pixel after its last, padding included, and the device, and stores what it finds.
    """
    inside, total = given.mask.reshape(-1), given.stack.shape[2]
    spans = [(start, stop) for start, stop in given.stack.bands(bytes_per_pixel) if inside[start:stop].any()]
    done = total - sum(stop - start for start, stop in spans)
    given.timings.advance(done)

    def advance(span: tuple[int, int]) -> None:
        nonlocal done
        done += span[1] - span[0]
        given.timings.advance(done)

    deal(given.devices, spans, lambda span, device: work(*span, device), advance)


def each_band(given: SolveInput, lights: Lights, field: NearField | None, work: Callable[[ReadBand], None]) -> None:
    """Do the image band by band on the devices, without the bands that lie outside the mask, and say how far it is.

    Args:
        given: the images.
        lights: lights of the stack, padded.
        field: where the lights are, where some light is near.
        work: stores what it finds in a band.
    """
    stack, inside = given.stack, given.mask.reshape(-1)
    factors = grey_factors(lights, GREY_WEIGHTS)

    def read(start: int, stop: int, device: str) -> None:
        span = slice(start, min(stop, stack.pixel_count))
        band = packs.upload(stack.band(start, stop), stack.saturated(start, stop), device=device)
        readings = grey_readings(band, factors)
        near = None if field is None else see_near(band, readings, field.at(np.arange(start, stop)))
        work(ReadBand(span, inside[span], band, readings, near))

    each_span(given, (READING_BYTES if field is None else NEAR_BYTES) * stack.shape[1], read)


def each_batch(given: SolveInput, lights: Lights, view: View, pixels: np.ndarray, work: Callable[[Batch], None], *, lobes: int,
               field: NearField | None = None, done: int = 0) -> None:
    """Do pixels of the images batch by batch on the devices, and say how far it is.

    Args:
        given: the images.
        lights: lights of the stack, padded.
        view: directions to the viewer.
        pixels: [n] positions, ascending.
        work: stores what it finds at the pixels of a batch.
        lobes: values that the solver keeps for each light and pixel.
        field: where the lights are, where some light is near.
        done: pixels of the stage that are done before.
    """
    stack, factors = given.stack, grey_factors(lights, GREY_WEIGHTS)
    size = max(1, BATCH_BYTES // (4 * (SAMPLE_FLOATS + lobes) * stack.light_count))

    def read(chosen: np.ndarray, device: str) -> None:
        start = int(chosen[0]) // PIXEL_PAD * PIXEL_PAD
        stop = (int(chosen[-1]) // PIXEL_PAD + 1) * PIXEL_PAD
        band = packs.upload(stack.band(start, stop), stack.saturated(start, stop), device=device)
        work(Batch(chosen, gather(band, chosen - start, view(chosen), lights, factors, stack.light_count,
                                  None if field is None else field.at(chosen))))

    def advance(chosen: np.ndarray) -> None:
        nonlocal done
        done += len(chosen)
        given.timings.advance(done)

    deal(given.devices, _cut(stack, pixels, size), read, advance)


def _cut(stack: Stack, pixels: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """Yield ascending positions in batches of at most `size`, each inside one band of the stack."""
    for start, stop in stack.bands(READING_BYTES * stack.shape[1]):
        local = pixels[(pixels >= start) & (pixels < stop)]
        for first in range(0, len(local), size):
            yield local[first : first + size]


def pick_pixels(given: SolveInput, lights: Lights, view: View, pixels: np.ndarray, field: NearField | None = None) -> Samples:
    """Return the readings of a few pixels, wherever they lie in the image.

    Args:
        given: the images.
        lights: lights of the stack, padded.
        view: directions to the viewer.
        pixels: [n] positions.
        field: where the lights are, where some light is near.
    """
    band = packs.upload(*given.stack.pick(pixels), device=given.device)
    return gather(band, np.arange(len(pixels)), view(pixels), lights, grey_factors(lights, GREY_WEIGHTS), given.stack.light_count,
                  None if field is None else field.at(pixels))


def readable(samples: Samples) -> np.ndarray:
    """Return [n] uint8 status: OK where enough frames have a reading and one of them is above zero. Waits for the device."""
    width = (samples.packs, samples.light_count) if samples.light_stride == 1 else (samples.light_count, samples.packs)
    values = samples.grey.numpy().reshape(*width, samples.lanes)
    values = values.transpose(1, 0, 2) if samples.light_stride == 1 else values
    values = values.reshape(samples.light_count, -1)[:, : samples.pixel_count]
    status = np.where((values > 0).any(axis=0), int(Status.OK), int(Status.DARK))
    return np.where((values >= 0).sum(axis=0) >= LEAST_READINGS, status, int(Status.TOO_FEW_LIGHTS)).astype(np.uint8)


def view_directions(camera: Camera) -> View:
    """Return the function that gives the direction from each pixel's surface point to the viewer."""
    if camera.projection == "orthographic":
        return lambda pixels: np.tile(np.array([0, 0, 1], dtype=np.float32), (len(pixels), 1))
    x, y = (plane.reshape(-1) for plane in camera.plane_coordinates())

    def toward(pixels: np.ndarray) -> np.ndarray:
        rays = np.stack([-x[pixels], -y[pixels], np.ones(len(pixels))], axis=1)
        return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)

    return toward
