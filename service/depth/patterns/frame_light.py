"""The light that frames hold: the largest reading there can be, and what the scene looks like under even light."""

from pathlib import Path

import numpy as np

from service.depth.patterns.readings import even_light
from stage.capture.capture import Capture
from stage.capture.manifest import Frame
from stage.colour.colour_spaces import is_linear
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.modulated import ModulatedCode
from stage.stack.correction import Correction
from stage.stack.pattern_exposures import JoinedExposures
from stage.stack.planes import Planes

SCALE_PERCENTILE = 99.9
"""Percentile of the brightest frame that is taken for full scale, for images in floating point without a given saturation."""
SCALE_SAMPLE = 500_000
"""Number of pixels of a frame from which full scale is taken."""


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
