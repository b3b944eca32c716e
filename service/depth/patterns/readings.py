"""The light that frames hold: those of a band on the device, the largest reading there can be, and what the scene looks like under even
light; white and black are made of phases where a capture has photographed neither.

The mean of a wave over its shifts is the light half way between white and black, and its amplitude is half their difference: a wave that is
resolved by camera and projector says what both frames would.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels.packs import Band
from kernels.structured.pattern_frames import saturated_bits, upload
from kernels.structured.phase import weights
from kernels.structured.response import bent_wave
from stage.capture.capture import Capture
from stage.capture.manifest import Frame
from stage.colour.colour import GREY_WEIGHTS
from stage.colour.colour_spaces import is_linear
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.modulated import ModulatedCode
from stage.patterns.phase import FULL_STEPS, PhaseCode
from stage.stack.correction import Correction
from stage.stack.pattern_exposures import JoinedExposures
from stage.stack.planes import Planes

DECODE_BYTES_PER_PIXEL = 200
"""Memory that decoding and triangulation take for each pixel, beside the planes."""
SCALE_PERCENTILE = 99.9
"""Percentile of the brightest frame that is taken for full scale, for images in floating point without a given saturation."""
SCALE_SAMPLE = 500_000
"""Number of pixels of a frame from which full scale is taken."""


class EvenLight(NamedTuple):
    """The rule that makes white and black of the phase frames of one period."""

    frames: tuple[int, ...]
    weights: np.ndarray  # [frames, 3] of each reading in the mean, the cosine and the sine
    mean: float = 0.5
    """Mean of the projected wave between black and white."""
    swing: float = 0.5
    """Amplitude of its fundamental, white minus black being 1."""

    def white_and_black(self, readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the frames of white and black would be, from all frames [frames, ...] of a band."""
        mean, along, across = np.tensordot(self.weights.T, readings[list(self.frames)], 1).astype(np.float32)
        whole = np.hypot(along, across) / np.float32(self.swing)
        return mean + np.float32(1 - self.mean) * whole, mean - np.float32(self.mean) * whole


def even_light(collected: Collected, response: Sequence[float] | None = None) -> EvenLight | None:
    """Return how white and black follow from the phases of a capture: from the longest period, which blur dims least.

    None if no period has three shifts. The response is the projector's light at even levels from 0 to 1; without one it is linear.
    """
    found = [(wave.period_px, EvenLight(wave.frames, weights(np.array(wave.shifts), wave.period_px)))
             for code in collected.codes if isinstance(code, PhaseCode) for wave in code.waves if len(wave.frames) >= FULL_STEPS]
    if not found:
        return None
    light = max(found, key=lambda pair: pair[0])[1]
    if response is None:
        return light
    wave = bent_wave(response)
    first = 2 * np.abs(np.fft.rfft(wave)[1]) / len(wave)
    return light._replace(mean=float(wave.mean()), swing=float(first))


class Readings(NamedTuple):
    """The frames of a band on the device."""

    grey: Band
    colour: Band | None
    """The frames with three channels; None if no code has colours."""
    columns: int
    """Number of pixels of an image row; the band consists of whole rows."""
    made: tuple[int, int] | None = None
    """White and black that are made of phases, as indices of `grey`; None if none are."""
    radiance: Band | None = None
    """The grey frames without the exposures of the pixels, where these differ; None: `grey` is."""

    @property
    def alike(self) -> Band:
        """Return grey frames whose neighbouring pixels can be compared, as the edges of stripes between them need."""
        return self.grey if self.radiance is None else self.radiance

    @classmethod
    def of(cls, values: np.ndarray, saturated: np.ndarray | None, columns: int, made: EvenLight | None, *, device: str,
           exposure: np.ndarray | None = None) -> "Readings":
        """Upload the frames of a band.

        Args:
            values: [frames, channels, pixels] float32; channels 1 or 3.
            saturated: [frames, pixels] bool; None when no reading saturates.
            exposure: [pixels] by which the values were multiplied; None: all by the same.
        """
        grey = grey_of(values)
        bits = None if saturated is None else saturated_bits(saturated)
        colour = upload(values, bits, device=device) if values.shape[1] > 1 else None
        radiance = None if exposure is None else upload(np.ascontiguousarray(grey / exposure), bits, device=device)
        if made is None:
            return cls(upload(np.ascontiguousarray(grey), bits, device=device), colour, columns, radiance=radiance)
        count = len(grey)
        grey = np.concatenate([grey, *(frame[None] for frame in made.white_and_black(grey))])
        if saturated is not None:
            cut = saturated[list(made.frames)].any(axis=0, keepdims=True)
            bits = saturated_bits(np.concatenate([saturated, cut, cut]))
        return cls(upload(grey, bits, device=device), colour, columns, (count, count + 1), radiance)


def grey_of(values: np.ndarray) -> np.ndarray:
    """Return [frames, pixels] of readings [frames, channels, pixels] float32."""
    return np.tensordot(values, np.array(GREY_WEIGHTS, np.float32), ([1], [0])) if values.shape[1] > 1 else values[:, 0]


def line_readings(planes: Planes, lines: np.ndarray, across: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the readings [frames, lines, length] of some image rows or columns, each pixel times its exposure as in bands, and where a
    frame is clipped [lines, length]."""
    def chosen(maps: np.ndarray | None) -> np.ndarray | None:
        """Return the lines of maps [..., rows, cols], the longer side last."""
        return None if maps is None else maps[..., lines, :] if across == 1 else np.swapaxes(maps[..., lines], -1, -2)

    values = np.moveaxis(planes.values[:, lines], 2, 1) if across == 1 else np.moveaxis(planes.values[..., lines], (2, 3), (1, 2))
    exposure, clipped = chosen(planes.exposure), chosen(planes.saturated)
    grey = grey_of(values.reshape(*values.shape[:2], -1)).reshape(len(values), *values.shape[2:])
    return grey if exposure is None else grey * exposure, None if clipped is None else np.asarray(clipped.any(axis=0))


def full_scale(planes: Planes, capture: Capture, frames: list[Frame]) -> float:
    """Return the largest reading there can be, in the unit of the corrected images."""
    exposure = min((frame.exposure_s for frame in frames if frame.exposure_s is not None), default=1.0)
    manifest = capture.manifest
    integers = all(Path(frame.image).suffix.lower() in (".png", ".jpg", ".jpeg") for frame in frames)
    if integers or not is_linear(manifest.color_space):
        return 1.0 / exposure
    if manifest.saturation is not None:
        return manifest.saturation / exposure
    every = max(1, planes.values[0].size // SCALE_SAMPLE)
    return max(float(max(np.percentile(frame.reshape(-1)[::every], SCALE_PERCENTILE) for frame in planes.values)), 1e-12)


def scene_colour(capture: Capture, frames: list[Frame], collected: Collected, joined: JoinedExposures | None = None) -> np.ndarray | None:
    """Return what the scene looks like, [rows, cols, 3] linear: the white frame, else a bit and its inverse, which add up to even light,
    else the mean of a wave over its shifts; None if the capture has none of them."""
    parts = {collected.white: 1.0} if collected.white is not None else {}
    for code in collected.codes:
        if not parts and isinstance(code, BinaryCode) and code.inverses is not None:
            parts = {code.frames[0]: 1.0, code.inverses[0]: 1.0}
    waves = even_light(collected)
    if not parts and waves is not None:
        parts = dict(zip(waves.frames, waves.weights[:, 0], strict=True))
    for code in collected.codes:
        if not parts and isinstance(code, ModulatedCode):
            parts = {number: 1.0 for step in code.frames for number in step}
    if not parts:
        return None
    read = Correction.of(capture).apply if joined is None else joined.read
    return np.asarray(np.sum([weight * read(frames[number]).pixels for number, weight in parts.items()], axis=0))
