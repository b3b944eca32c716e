"""The pixels of an image as readings on the device, as many at a time as memory allows."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from kernels import device as devices
from kernels import packs
from kernels.device import to_numpy
from kernels.photometric.lambertian.near import NearField, NearLights, see_near
from kernels.photometric.lambertian.readings import Lights, Readings, grey_factors, grey_readings
from kernels.photometric.model.samples import Samples, gather
from kernels.status import Status
from service.sharing.sharing import Results, deal
from service.solve.base.solution import SolveInput
from stage.capture.camera import Camera
from stage.colour.colour import GREY_WEIGHTS

READING_BYTES = 4
"""A grey reading, per light and pixel, beside the stack's band."""
NEAR_BYTES = READING_BYTES + 16
"""The same where lights are near: with a direction and a falloff."""
SAMPLE_FLOATS = 7
"""Numbers per light and pixel of the samples: grey and colour readings, direction."""
BATCH_BYTES = 256 << 20
"""Memory for the samples and lobes that are worked on at one time, on a GPU the least."""
LEAST_READINGS = 3
"""Frames with a reading, dark or not, that a normal needs."""

Piece = TypeVar("Piece")
View = Callable[[np.ndarray], np.ndarray]
"""A function from pixel positions (row-major, [n]) to unit directions to the viewer [n, 3] float32."""


class ReadBand(NamedTuple):
    """A band of the image with its readings on the device."""

    span: slice
    """Pixels of the band, as row-major positions in the image."""
    inside: np.ndarray  # [n] bool: which of these pixels are inside the mask
    band: packs.Band
    readings: Readings
    near: NearLights | None
    """Direction and falloff of each light at each pixel, where some light is near."""


class Batch(NamedTuple):
    """Chosen pixels with their readings on the device."""

    pixels: np.ndarray  # [n] row-major positions in the image
    samples: Samples


def each_span(given: SolveInput, bytes_per_pixel: int, work: Callable[[int, int, str], None], results: Results) -> None:
    """Do the pixel ranges of the image that touch the mask on the devices, and say how far it is.
    `bytes_per_pixel`: what the work allocates for each pixel beside the stack. `work`: takes the range's first pixel, the pixel after
    its last, padding included, and the device, and stores what it finds."""
    inside, total = given.mask.reshape(-1), given.stack.shape[2]
    spans = [(start, stop) for start, stop in given.images[given.device].spans(bytes_per_pixel) if inside[start:stop].any()]
    _deal(given, spans, lambda span, device: work(*span, device), results, size=lambda span: span[1] - span[0],
          done=total - sum(stop - start for start, stop in spans),
          pixels_of=lambda span: slice(span[0], min(span[1], given.stack.pixel_count)))


def _deal(given: SolveInput, pieces: Sequence[Piece], work: Callable[[Piece, str], None], results: Results, *,
          size: Callable[[Piece], int], done: int, pixels_of: Callable[[Piece], Any]) -> None:
    """Do pieces on the devices of this worker, and of others that share the solve; `done` pixels of the stage are done before."""
    def tell(pixels: int) -> None:
        nonlocal done
        done += pixels
        given.timings.advance(done)

    tell(0)
    names = [device for device in given.devices for _ in range(devices.pieces_at_once(device))]
    if given.sharing is None:
        deal(names, pieces, work, lambda piece: tell(size(piece)))
    else:
        given.sharing.deal(names, pieces, work, lambda piece: tell(size(piece)), waiting=lambda: tell(0), pixels_of=pixels_of,
                           results=results)
    for device in set(given.devices):
        given.images[device].finish()


def each_band(given: SolveInput, lights: Lights, field: NearField | None, work: Callable[[ReadBand], None], results: Results) -> None:
    """Do the image band by band on the devices, without the bands that lie outside the mask, and say how far it is.
    `results`: where the work stores what it finds, and what that follows from besides the arguments."""
    stack, inside = given.stack, given.mask.reshape(-1)
    factors = grey_factors(lights, GREY_WEIGHTS)

    def read(start: int, stop: int, device: str) -> None:
        span = slice(start, min(stop, stack.pixel_count))
        band = given.images[device].band(start, stop)
        readings = grey_readings(band, factors)
        near = None if field is None else see_near(band, readings, field.at(np.arange(start, stop)))
        work(ReadBand(span, inside[span], band, readings, near))

    each_span(given, (READING_BYTES if field is None else NEAR_BYTES) * stack.shape[1], read,
              results._replace(follows_from=(lights, field, results.follows_from)))


def each_batch(given: SolveInput, lights: Lights, view: View, pixels: np.ndarray, work: Callable[[Batch], None], results: Results, *,
               lobes: int, field: NearField | None = None, done: int = 0) -> None:
    """Do pixels of the images batch by batch on the devices, and say how far it is.

    Args:
        pixels: [n] positions, ascending.
        results: where the work stores what it finds, and what that follows from besides the arguments.
        lobes: values that the solver keeps for each light and pixel.
        done: pixels of the stage that are done before.
    """
    stack, factors = given.stack, grey_factors(lights, GREY_WEIGHTS)
    size = max(1, devices.batch_bytes(given.device, BATCH_BYTES) // (4 * (SAMPLE_FLOATS + lobes) * stack.light_count))

    def read(piece: slice, device: str) -> None:
        chosen = pixels[piece]
        band, places = given.images[device].around(chosen)
        work(Batch(chosen, gather(band, places, view(chosen), lights, factors, stack.light_count,
                                  None if field is None else field.at(chosen))))

    _deal(given, _cut(given, pixels, size), read, results._replace(follows_from=(lights, field, pixels, results.follows_from)),
          size=lambda piece: piece.stop - piece.start, done=done, pixels_of=lambda piece: pixels[piece])


def _cut(given: SolveInput, pixels: np.ndarray, size: int) -> list[slice]:
    """Cut ascending positions into batches of at most `size`; on the CPU, where a batch is a view, each inside one band of the stack."""
    found, stack = [], given.stack
    for start, stop in stack.bands(READING_BYTES * stack.shape[1]) if given.device == "cpu" else [(0, stack.pixel_count)]:
        first, last = (int(place) for place in np.searchsorted(pixels, (start, stop)))
        found += [slice(begin, min(begin + size, last)) for begin in range(first, last, size)]
    return found


def pick_pixels(given: SolveInput, lights: Lights, view: View, pixels: np.ndarray, field: NearField | None = None) -> Samples:
    """Return the readings of a few pixels, [n] positions, wherever they lie in the image."""
    band = given.images[given.device].pick(pixels)
    return gather(band, np.arange(len(pixels)), view(pixels), lights, grey_factors(lights, GREY_WEIGHTS), given.stack.light_count,
                  None if field is None else field.at(pixels))


def readable(samples: Samples) -> np.ndarray:
    """Return [n] uint8 status: OK where enough frames have a reading and one of them is above zero. Waits for the device."""
    width = (samples.packs, samples.light_count) if samples.light_stride == 1 else (samples.light_count, samples.packs)
    values = to_numpy(samples.grey).reshape(*width, samples.lanes)
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
