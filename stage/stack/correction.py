"""Correction of recorded values to scene-linear radiance by colour space, dark frame, flat field, colours, exposure and ambient light."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.capture.capture import Capture
from stage.capture.light import OffLight
from stage.capture.manifest import ColorMatrix, Frame, Manifest
from stage.colour import radiance
from stage.colour.colour import linearise
from stage.colour.colour_spaces import channels_apart, is_linear
from stage.errors import ImageError
from stage.formats import exr, images
from stage.spread import MAD_TO_SIGMA

FULL_SCALE = 1.0
"""The largest integer as `images.read_pixels` gives it."""
BRIGHTER_DARK, BRIGHTER_OFF = 0.25, 0.5
"""Parts of the mask from which on a dark image, and `off` frames, are refused that are brighter there than an image: sensors have pixels
that glow more in one image than in another, and light of a room flickers."""
LOOKED_AT = 1 << 18
"""About how many differences of neighbours are looked at in a larger image."""


def saturation_limit(manifest: Manifest, path: Path) -> float:
    """Return the recorded value at and above which the readings of an image are saturated: the manifest's, else the largest of integers,
    else infinity."""
    return manifest.saturation if manifest.saturation is not None else FULL_SCALE if images.read_header(path).integer else np.inf


class Radiance(NamedTuple):
    """The corrected pixels of one image, and which of them saturate."""

    pixels: np.ndarray  # [rows, cols, 3] float32, scene-linear; may be below 0 by noise once dark or ambient is taken off
    saturated: np.ndarray | None  # [rows, cols] bool, any channel at or above the capture's `saturation`, or its largest integer


class CodedRadiance(NamedTuple):
    """Corrected pixels of one image of integers or of half values, where one code stands for the same radiance everywhere."""

    codes: np.ndarray  # [rows, cols, 3] uint8 or uint16 as recorded, or the bits of half values
    values: np.ndarray  # [256] or [65536] float32, the scene-linear radiance of each code, which rises with the integer or half value
    saturated: np.ndarray | None  # as in Radiance


@dataclass(frozen=True)
class Correction:
    """The correction of every frame of a capture.

    radiance = color_matrix · ((linear(recorded) - dark) / flat / exposure - ambient), with the flat field scaled to mean 1 over the mask.
    """

    capture: Capture
    dark: np.ndarray | None  # [rows, cols, 3] float32, linear; taken at the exposure of the frames
    flat: np.ndarray | None  # [rows, cols, 3] float32, mean 1 in each channel
    ambient: np.ndarray | None  # [rows, cols, 3] float32, mean of the `off` frames, corrected but for their colours
    full_scale: bool = False
    """True to mark the largest value of integers as saturated where the capture gives no `saturation`."""
    note: Callable[[str, np.ndarray], None] | None = None
    """Called with the image and the recorded values, [rows, cols, 3], of every frame that is read."""

    @classmethod
    def of(cls, capture: Capture, *, full_scale: bool = False) -> "Correction":
        """Read the dark, flat and ambient frames of a capture and return its correction.
        `full_scale`: True to mark the largest value of integers as saturated where the capture gives no `saturation`. Raises ImageError if
        a frame is unreadable or holds impossible values, or the flat field is dark inside the mask."""
        manifest, whole = capture.manifest, capture.whole or capture
        space = manifest.color_space
        dark = flat = None
        if manifest.dark is not None:
            dark = linearise(whole.recorded(manifest.dark), space)
        if manifest.flat is not None:
            flat = linearise(whole.recorded(manifest.flat), space)
            flat = flat - dark if dark is not None else flat
            mask = whole.mask()  # so that a part of the images has the brightness that it has in the whole
            unlit = int((flat[mask] <= 0).any(axis=-1).sum())
            if unlit:
                raise ImageError(f"{capture.file(manifest.flat)}: flat is not above dark at {unlit} of the mask's pixels")
            flat = np.where(flat > 0, flat, 1) / flat[mask].mean(axis=0)
        dark, flat = (None if image is None else capture.part_of(image) for image in (dark, flat))
        partial = cls(replace(capture, manifest=manifest.with_colors(None)), dark, flat, None, full_scale)
        off = [frame for frame, _ in partial.capture.lit_by(OffLight)]
        if not off:
            return cls(capture, dark, flat, None, full_scale)
        total = np.zeros((capture.camera.height, capture.camera.width, 3), dtype=np.float32)
        for frame in off:
            total += partial.apply(frame).pixels
        return cls(capture, dark, flat, total / len(off), full_scale)

    def apply(self, frame: Frame) -> Radiance:
        """Read one frame and correct it."""
        coded = self.coded(frame)
        if isinstance(coded, Radiance):
            return coded
        return Radiance(np.take(coded.values, coded.codes), coded.saturated)

    def coded(self, frame: Frame) -> Radiance | CodedRadiance:
        """Read one frame and correct it, and leave integers and half values as they are where `has_codes`."""
        manifest = self.capture.manifest
        recorded = self.capture.recorded(frame.image, keep_half=True)
        if self.note is not None:
            self.note(frame.image, recorded)
        saturated: np.ndarray | None = None
        limit = manifest.saturation
        if limit is None and self.full_scale:
            integer = recorded.dtype.kind == "u" or images.read_header(self.capture.file(frame.image)).integer  # 32 bits are read as float
            limit = FULL_SCALE if integer else None
        if limit is not None:
            saturated = any_from(limit, recorded)
        if self._is_pointwise(frame) and (recorded.dtype.kind == "u" or (recorded.dtype == np.float16 and is_linear(manifest.color_space))):
            codes = recorded if recorded.dtype.kind == "u" else recorded.view(np.uint16)
            every = np.arange(np.iinfo(codes.dtype).max + 1, dtype=codes.dtype)
            if recorded.dtype == np.float16:
                every = every.view(np.float16).astype(np.float32)
                every[~np.isfinite(every)] = 0  # which no image has
            return CodedRadiance(codes, self.corrected(every, frame), saturated)
        code = 1 / np.iinfo(recorded.dtype).max if recorded.dtype.kind == "u" else 0.0
        if recorded.dtype == np.float16:
            recorded = recorded.astype(np.float32)
        pixels = self._subtracted(recorded, frame)
        if self.dark is not None or self.ambient is not None:
            pixels = self._checked(frame, pixels, code / (frame.exposure_s or 1.0))
        return Radiance(self._in_colours(pixels, frame), saturated)

    def _checked(self, frame: Frame, pixels: np.ndarray, code: float) -> np.ndarray:
        """Return a frame of which dark or ambient light was taken off, by more than its noise and a code of integers at no more pixels than
        glow or flicker; the values below noise are set to 0 where the capture asks for it."""
        if self.capture.pixels.clip_negative:
            pixels, count = radiance.clip_negative(pixels)
            if count:
                self.capture.clipped[frame.image] = max(count, self.capture.clipped.get(frame.image, 0))
            return pixels
        change = np.abs(np.diff(pixels[:: max(1, pixels.size // LOOKED_AT)], axis=1))  # small images do not tell their noise around zero
        rough = radiance.NOISE_SIGMAS * MAD_TO_SIGMA / 2**0.5 * (np.median(change, axis=(0, 1)) if change.size else 0.0)
        below = np.any(pixels < np.minimum(radiance.noise_floor(pixels), -rough) - code, axis=-1)[self._mask]
        brighter, most = ("dark", BRIGHTER_DARK) if self.ambient is None else ("an `off` frame", BRIGHTER_OFF)
        if below.sum() > most * below.size:
            raise ImageError(f"{self.capture.file(frame.image)}: {brighter} is brighter at {int(below.sum())} of {below.size} pixels of "
                             f"the mask, by {-float(pixels.min()):.2g} at most: check its exposure; {radiance.CLIP_NEGATIVE}")
        return pixels

    @cached_property
    def _mask(self) -> np.ndarray:
        """The mask of the object, which all frames share."""
        return self.capture.mask()

    def has_codes(self, frame: Frame) -> bool:
        """Return whether a frame has integers or half values of which each stands for one radiance, as its header tells."""
        header = images.read_header(self.capture.file(frame.image))
        return self._is_pointwise(frame) and (header.integer or (header.half and is_linear(self.capture.manifest.color_space)))

    def _is_pointwise(self, frame: Frame) -> bool:
        """Return whether no dark, flat or ambient frame tells pixels apart, and no matrix or colour space mixes their channels."""
        apart = self._matrix(frame) is None and channels_apart(self.capture.manifest.color_space)
        return apart and self.dark is None and self.flat is None and self.ambient is None

    def at(self, pixels: np.ndarray) -> "Correction":
        """Return the correction of single pixels.
        `pixels`: [n] row-major positions in the image. Returns a correction whose images are [n, 1, 3], for `corrected`."""
        dark, flat, ambient = (None if image is None else image.reshape(-1, 1, 3)[pixels] for image in (self.dark, self.flat, self.ambient))
        return replace(self, dark=dark, flat=flat, ambient=ambient)

    def corrected(self, recorded: np.ndarray, frame: Frame) -> np.ndarray:
        """Return the scene-linear radiance of recorded values of a frame, [rows, cols, 3] float32 of the same size as the images here.
        `recorded`: [rows, cols, 3] float32 fractions of full scale, or uint8 or uint16."""
        return self._in_colours(self._subtracted(recorded, frame), frame)

    def _subtracted(self, recorded: np.ndarray, frame: Frame) -> np.ndarray:
        """Return the same in the channels of the camera."""
        pixels = linearise(recorded, self.capture.manifest.color_space)
        if self.dark is not None:
            pixels = pixels - self.dark
        if self.flat is not None:
            pixels = pixels / self.flat
        if frame.exposure_s is not None:
            pixels = pixels / np.float32(frame.exposure_s)
        if self.ambient is not None:
            pixels = pixels - self.ambient
        return pixels

    def _in_colours(self, pixels: np.ndarray, frame: Frame) -> np.ndarray:
        matrix = self._matrix(frame)
        return pixels if matrix is None else pixels @ np.array(matrix, np.float32).T

    def _matrix(self, frame: Frame) -> ColorMatrix | None:
        return frame.color_matrix or self.capture.manifest.color_matrix


def any_from(limit: float, recorded: np.ndarray) -> np.ndarray:
    """Return whether any channel of a pixel is at or above a limit.
    `limit`: a fraction of full scale, or a floating-point value. `recorded`: [rows, cols, 3] uint8, uint16, float16 or float32. Returns
    [rows, cols] bool."""
    least: np.float32 | int = np.float32(limit)
    if recorded.dtype.kind == "u":  # the first integer that stands for as much; past the last where none does
        least = int(np.searchsorted(images.fractions(recorded.dtype), least))
    elif recorded.dtype == np.float16:  # as integers, which rise with the values above zero and are below zero with them
        half = np.float16(min(limit, exr.HALF_MAX))
        least = int((half if half >= least else np.nextafter(half, np.float16(np.inf))).view(np.int16))
        recorded = recorded.view(np.int16)
    if recorded.max() < least:
        return np.zeros(recorded.shape[:2], dtype=bool)
    red, green, blue = (recorded[..., channel] >= least for channel in range(3))
    return red | green | blue
