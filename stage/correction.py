"""Correction of recorded values to scene-linear radiance by colour space, dark frame, flat field, exposure and ambient light."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stage import images
from stage.capture import Capture
from stage.colour import linearise
from stage.errors import ImageError
from stage.light import OffLight
from stage.manifest import Frame

FULL_SCALE = 1.0
"""The largest integer as `images.read_pixels` gives it."""


class Radiance(NamedTuple):
    """The corrected pixels of one image, and which of them saturate."""

    pixels: np.ndarray  # [rows, cols, 3] float32, scene-linear; may be below 0 by noise once dark or ambient is taken off
    saturated: np.ndarray | None  # [rows, cols] bool, any channel at or above the capture's `saturation`, or its largest integer


@dataclass(frozen=True)
class Correction:
    """The correction of every frame of a capture.

    radiance = (linear(recorded) - dark) / flat / exposure - ambient, with the flat field scaled to mean 1 over the mask.
    """

    capture: Capture
    dark: np.ndarray | None  # [rows, cols, 3] float32, linear; taken at the exposure of the frames
    flat: np.ndarray | None  # [rows, cols, 3] float32, mean 1 in each channel
    ambient: np.ndarray | None  # [rows, cols, 3] float32, mean of the `off` frames, corrected
    full_scale: bool = False
    """True to mark the largest value of integers as saturated where the capture gives no `saturation`."""

    @classmethod
    def of(cls, capture: Capture, *, full_scale: bool = False) -> "Correction":
        """Read the dark, flat and ambient frames of a capture and return its correction.

        Args:
            capture: an opened capture.
            full_scale: True to mark the largest value of integers as saturated where the capture gives no `saturation`.

        Raises:
            ImageError: a frame is unreadable or holds impossible values, or the flat field is dark inside the mask.
        """
        manifest = capture.manifest
        space = manifest.color_space
        dark = flat = None
        if manifest.dark is not None:
            dark = linearise(_recorded(capture, manifest.dark), space)
        if manifest.flat is not None:
            flat = linearise(_recorded(capture, manifest.flat), space)
            flat = flat - dark if dark is not None else flat
            mask = capture.mask()
            unlit = int((flat[mask] <= 0).any(axis=-1).sum())
            if unlit:
                raise ImageError(f"{capture.file(manifest.flat)}: flat is not above dark at {unlit} of the mask's pixels")
            flat = np.where(flat > 0, flat, 1) / flat[mask].mean(axis=0)
        partial = cls(capture, dark, flat, None, full_scale)
        off = [frame for frame, _ in capture.lit_by(OffLight)]
        if not off:
            return partial
        total = np.zeros((capture.camera.height, capture.camera.width, 3), dtype=np.float32)
        for frame in off:
            total += partial.apply(frame).pixels
        return cls(capture, dark, flat, total / len(off), full_scale)

    def apply(self, frame: Frame) -> Radiance:
        """Read one frame and correct it.

        Raises:
            ImageError: the file is unreadable, or a recorded value is NaN, infinite or negative; the message names the file.
        """
        manifest = self.capture.manifest
        recorded = _recorded(self.capture, frame.image)
        saturated: np.ndarray | None = None
        limit = manifest.saturation
        if limit is None and self.full_scale and images.read_header(self.capture.file(frame.image)).integer:
            limit = FULL_SCALE
        if limit is not None:
            red, green, blue = (recorded[..., channel] >= limit for channel in range(3))
            saturated = red | green | blue
        pixels = linearise(recorded, manifest.color_space)
        if self.dark is not None:
            pixels = pixels - self.dark
        if self.flat is not None:
            pixels = pixels / self.flat
        if frame.exposure_s is not None:
            pixels = pixels / np.float32(frame.exposure_s)
        if self.ambient is not None:
            pixels = pixels - self.ambient
        return Radiance(pixels, saturated)


def _recorded(capture: Capture, name: str) -> np.ndarray:
    path = capture.file(name)
    pixels = images.read_pixels(path)
    images.check_radiance(path, pixels)
    return pixels.astype(np.float32, copy=False)
