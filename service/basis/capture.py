"""The opened capture that every kind of basis is made from, its bands on the device, its images as a display shows them, and the result.

A display shows each image as under one white light: exposed, in the display's primaries, clipped and encoded.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import packs
from kernels.packs import Band
from kernels.relight.basis.rti import encode
from service.errors import RequestError
from service.light_estimation.declared_lights import declared_light_sentences
from service.relight.clipping import Clipping
from service.relight.findings import LEAST_CLIPPED, clipped_sentence
from service.reporting.progress import Timings
from service.reporting.provenance import metadata
from service.requests.basis import BasisKind, BasisRequest
from service.requests.publish import PublishRequest
from stage.capture.capture import Capture
from stage.capture.light import PointLight
from stage.capture.lighting import lights_from_centre
from stage.capture.manifest import FILE_NAME
from stage.capture.point_lights import DistantLights
from stage.colour.colour import rgb_matrix
from stage.colour.colour_spaces import linear_space
from stage.errors import ManifestError
from stage.motion.tracking import tracking_frames
from stage.results.light_basis import facts_path, numbers
from stage.stack.brackets import merge_brackets
from stage.stack.ingest import open_stack
from stage.stack.stack import Stack

DISPLAY_SPACE = "lin_rec709_scene"
"""The linear space of an sRGB display."""
WHITE_PERCENTILE = 99.9
EXPOSURE_PIXELS = 1 << 16
"""Most pixels that the exposure is measured on; of more, evenly spread ones are taken."""


class BasisCapture(NamedTuple):
    """An opened capture."""

    capture: Capture
    stack: Stack
    lights: DistantLights
    near: int
    """Number of point lights among them, which are taken as distant ones."""
    inside: np.ndarray  # [pixels padded] bool: which pixels are inside the mask
    space: str
    """The scene-linear colour space of the stack."""
    provenance: dict[str, str]
    warnings: tuple[str, ...]
    """Sentences about readings that are clipped."""

    @property
    def where(self) -> str:
        """The path of the manifest, for messages."""
        return str(self.capture.folder / FILE_NAME)

    @property
    def pixels(self) -> int:
        """The number of pixels inside the mask."""
        return int(self.inside.sum())

    def described_lights(self, chosen: np.ndarray) -> list[dict[str, Any]]:
        """Return image, direction and irradiance of the chosen lights, for JSON."""
        return [{"image": self.stack.frames[i], "direction": numbers(self.lights.direction[i]),
                 "irradiance": numbers(self.lights.irradiance[i])} for i in chosen]


class BasisResult(NamedTuple):
    """The files of a basis, and how much is lost."""

    path: Path
    facts_path: Path
    """The JSON file beside it."""
    kind: BasisKind
    terms: int
    """The number of coefficients of each channel."""
    pixels: int
    lights: int
    left_out: int
    """Number of lights that are not in front of the object, and so not in an RTI file."""
    near_lights: int
    relative_rms: float
    """Root mean square of (image as the file gives it − image), divided by that of the images."""
    levels_rms: float | None
    """The same in steps of an 8-bit display, where the file holds display values."""
    warnings: tuple[str, ...]
    key_lights_rms: float | None
    """Relative error of pictures under key lights from between the captured lights, where the file gives sums of images."""


def open_capture(request: BasisRequest | PublishRequest, timings: Timings) -> BasisCapture:
    """Open the capture of a request, none of whose images a result may replace."""
    timings.stage("open", 1)
    capture = Capture.open(request.capture, request.pixels)
    lights = lights_from_centre(capture)
    mask = capture.mask()
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    inputs = {capture.file(name).resolve() for _, name in capture.files()}
    for path in (request.out, facts_path(request.out)):
        if path.resolve() in inputs:
            raise RequestError(f"--out {request.out}: {path} is an input: choose another folder or name")
    timings.stage("ingest", len(capture.sources()))
    stack = merge_brackets(open_stack(capture, cache=request.cache, tracking=tracking, progress=lambda done, _: timings.advance(done)),
                           capture.sources(), lights)
    inside = np.zeros(stack.shape[2], dtype=bool)
    inside[: stack.pixel_count] = mask.reshape(-1)
    near = len(capture.lit_by(PointLight))
    provenance = metadata(request, capture=capture.name, inputs=stack.key, near_lights=near)
    clipping = Clipping.of(stack, inside[: stack.pixel_count])
    shares = clipping.share(np.broadcast_to(stack.scale, (1, 3, len(stack.scale))))[0]
    clipped = [clipped_sentence(shares, clipping.pixels, "the picture under all lights")] if shares.max() >= LEAST_CLIPPED else []
    warnings = (*capture.doubts, *declared_light_sentences(stack, capture, lights, mask), *clipped)
    return BasisCapture(capture, stack, lights, near, inside, linear_space(capture.manifest.color_space), provenance, warnings)


class StackBand(NamedTuple):
    """A band of the stack with some pixel inside the mask."""

    span: slice
    """The pixels of the band in the image, without padding."""
    band: packs.Band
    inside: np.ndarray  # [pixels of the band] bool


def stack_bands(source: BasisCapture, device: str, bytes_per_pixel: int, timings: Timings, stage: str) -> Iterator[StackBand]:
    """Yield the bands of the stack on the device, without those that have no pixel inside the mask, as one stage of the work.
    `bytes_per_pixel`: what the caller allocates beside the stack for each pixel."""
    ranges = list(source.stack.bands(bytes_per_pixel))
    timings.stage(stage, len(ranges))
    for done, (start, stop) in enumerate(ranges, start=1):
        if source.inside[start:stop].any():
            band = packs.upload(source.stack.band(start, stop), device=device)
            yield StackBand(slice(start, min(stop, source.stack.pixel_count)), band, source.inside[start:stop])
        timings.advance(done)


class Display(NamedTuple):
    """How stored values become display values."""

    front: np.ndarray  # indices of the lights with z > 0
    gains: np.ndarray  # [3, lights padded], from stored to exposed scene-linear values; 0 for lights left out
    from_stack: np.ndarray  # [3, 3]
    exposure: float

    def shown(self, band: Band) -> Band:
        """Return the display values of a band."""
        return encode(band, self.gains, self.from_stack)

    def of_sample(self, sample: np.ndarray) -> np.ndarray:
        """Return the display values of stored_sample, [3, lights in front, pixels] float32."""
        scene = sample * self.gains[:, self.front, None].astype(np.float32)
        return srgb(np.tensordot(self.from_stack.astype(np.float32), scene, axes=1))


def stored_sample(source: BasisCapture, front: np.ndarray) -> np.ndarray:
    """Return the stored values of evenly spread pixels of the object, [3, lights in front, pixels] float32."""
    pixels = np.flatnonzero(source.inside)
    spread = np.linspace(0, len(pixels) - 1, min(EXPOSURE_PIXELS, len(pixels))).astype(int)  # no whole step, which could meet few columns
    values, _ = source.stack.pick(pixels[spread])
    return np.asarray(values[:, front], dtype=np.float32)


def display_of(source: BasisCapture, front: np.ndarray, sample: np.ndarray, kind: str) -> Display:
    """Return the display values that files of a kind hold, for the lights in front of the object.
    `sample`: stored_sample, which is exposed. Raises ManifestError if a light has no irradiance in a channel, or the object is black."""
    irradiance = source.lights.irradiance
    dark = np.argwhere(irradiance[front] <= 0)
    if len(dark):
        light, channel = dark[0]
        raise ManifestError(f"{source.where}: light.irradiance of {source.stack.frames[front[light]]}: is 0 in channel "
                            f"{'RGB'[channel]}: {kind} shows the object under white light")
    gains = np.zeros((3, source.stack.shape[1]))
    gains[:, front] = (source.stack.scale[front, None] / irradiance[front]).T
    matrix = rgb_matrix(source.space, DISPLAY_SPACE)
    scene = sample * gains[:, front, None].astype(np.float32)
    white = float(np.quantile(np.tensordot(matrix, scene, axes=1), WHITE_PERCENTILE / 100))
    if not white > 0:
        raise ManifestError(f"{source.where}: frames: the object is black under every light in front of it")
    exposure = 1 / white
    return Display(front, gains * exposure, matrix, exposure)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Return the values of linear ones for an sRGB display, limited to 0…1 (IEC 61966-2-1)."""
    limited = np.clip(linear, 0, 1)
    return np.where(limited <= 0.0031308, 12.92 * limited, 1.055 * limited ** np.float32(1 / 2.4) - np.float32(0.055))
