"""The captured images as a display shows them, each as under one white light: exposed, in the display's primaries, clipped and encoded."""

from typing import NamedTuple

import numpy as np

from kernels.packs import Band
from kernels.relight.basis.rti import encode
from service.basis.capture import BasisCapture
from stage.colour.colour import rgb_matrix
from stage.errors import ManifestError

DISPLAY_SPACE = "lin_rec709_scene"
"""The linear space of an sRGB display."""
WHITE_PERCENTILE = 99.9
EXPOSURE_PIXELS = 1 << 16
"""Most pixels that the exposure is measured on; of more, evenly spread ones are taken."""


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

    Args:
        sample: stored_sample, which is exposed.

    Raises:
        ManifestError: a light has no irradiance in a channel, or the object is black.
    """
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
