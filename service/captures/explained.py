"""What explains the images of a capture better than its manifest, from some pixels of each frame: encoding, brightness, order of lights."""

from collections.abc import Mapping

import numpy as np

from stage.capture import Capture
from stage.consistency.explanations import MIN_LIGHTS, PIXELS, Sample, better_explanation, fit_manifest
from stage.consistency.sentences import explanation_sentence
from stage.correction import FULL_SCALE, Correction
from stage.errors import StageError
from stage.images import read_header
from stage.light import DistantLight
from stage.lighting import has_placeholders


def pixels_to_look_at(capture: Capture) -> np.ndarray | None:
    """Return the row-major positions [n] of some pixels of the object; None where the lights of the capture contradict nothing.

    Lambert's law contradicts a manifest of distant lights only, and only where there are more of them than unknowns.
    """
    lit = capture.lit_by(DistantLight)
    if len(lit) < MIN_LIGHTS or len(lit) < len(capture.sources()) or has_placeholders(capture):
        return None
    try:
        inside = np.flatnonzero(capture.mask())
    except StageError:
        return None
    return inside[np.unique(np.linspace(0, len(inside) - 1, min(PIXELS, len(inside))).astype(int))]


def findings(capture: Capture, positions: np.ndarray, recorded: Mapping[str, np.ndarray]) -> list[str]:
    """Return a sentence about what explains the images much better than the manifest; none where it explains them well.

    Args:
        capture: whose frames are lit by distant lights.
        positions: of pixels_to_look_at.
        recorded: [n, 3] float32 of each frame at these pixels, by the name of its image: fractions of full scale, or floating-point values.

    Raises:
        StageError: a dark, flat or ambient frame cannot be used.
    """
    lit = capture.lit_by(DistantLight)
    correction = Correction.of(capture).at(positions)
    radiance = np.stack([correction.corrected(recorded[frame.image][:, None], frame)[:, 0] for frame, _ in lit]).astype(np.float64)
    limit = capture.manifest.saturation
    limits = [limit or (FULL_SCALE if read_header(capture.file(frame.image)).integer else np.inf) for frame, _ in lit]
    usable = np.stack([(recorded[frame.image] < np.float32(most)).all(axis=-1) for (frame, _), most in zip(lit, limits, strict=True)])
    sample = Sample(radiance, usable, np.array([light.direction for _, light in lit]), np.array([light.irradiance for _, light in lit]),
                    np.array([frame.exposure_s or 1.0 for frame, _ in lit]), capture.manifest.color_space)
    found = better_explanation(sample, fit_manifest(sample))
    return [] if found is None else [explanation_sentence(found, sample)]
