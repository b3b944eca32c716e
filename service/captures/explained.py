"""Compare some pixels of each frame with the manifest, and report contradictions: encoding, brightness, order, single lights."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from service.light_estimation.explanations import (
    MIN_LIGHTS,
    PIXELS,
    Sample,
    better_explanation,
    explanation_sentence,
    fit_manifest,
    grey_readings,
)
from service.light_estimation.lambertian import Fit, Suspect, suspects
from stage.capture.capture import Capture
from stage.capture.light import DistantLight
from stage.capture.lighting import has_placeholders
from stage.errors import StageError
from stage.formats.images import read_header
from stage.stack.correction import FULL_SCALE, Correction

MOST_NAMED = 6
"""The most lights that a sentence names."""


def pixels_to_look_at(capture: Capture) -> np.ndarray | None:
    """Return the row-major positions [n] of some pixels of the object; None where the lights of the capture contradict nothing.

    Lambert's law contradicts a manifest of distant lights only, and only where there are more of them than unknowns.
    """
    lit = capture.lit_by(DistantLight)
    if len(lit) < MIN_LIGHTS or len(lit) < len(capture.sources()) or has_placeholders(capture) or capture.is_polarised:
        return None
    try:
        inside = np.flatnonzero(capture.mask())
    except StageError:
        return None
    return inside[np.unique(np.linspace(0, len(inside) - 1, min(PIXELS, len(inside))).astype(int))]


class Findings(NamedTuple):
    """Contradictions between the images and the manifest."""

    sentences: list[str]
    suspects: dict[str, float]
    """The misfit of each light that disagrees with the others, by its image, worst first."""


def findings(capture: Capture, positions: np.ndarray, recorded: Mapping[str, np.ndarray]) -> Findings:
    """Return what explains the images much better than the manifest, else the lights that disagree with the others.
    `recorded`: [n, 3] float32 of each frame at these pixels, by the name of its image: fractions of full scale, or floating-point
    values."""
    lit = capture.lit_by(DistantLight)
    correction = Correction.of(capture).at(positions)
    radiance = np.stack([correction.corrected(recorded[frame.image][:, None], frame)[:, 0] for frame, _ in lit]).astype(np.float64)
    limit = capture.manifest.saturation
    limits = [limit or (FULL_SCALE if read_header(capture.file(frame.image)).integer else np.inf) for frame, _ in lit]
    usable = np.stack([(recorded[frame.image] < np.float32(most)).all(axis=-1) for (frame, _), most in zip(lit, limits, strict=True)])
    sample = Sample(radiance, usable, np.array([light.direction for _, light in lit]), np.array([light.irradiance for _, light in lit]),
                    np.array([frame.exposure_s or 1.0 for frame, _ in lit]), capture.manifest.color_space)
    fit = fit_manifest(sample)
    if (found := better_explanation(sample, fit)) is not None:
        return Findings([explanation_sentence(found, sample)], {})
    off = _suspects(sample, fit)
    named = {lit[each.light][0].image: each.misfit for each in off}
    if not named:
        return Findings([], {})
    some = ", ".join(f"{image} (by {100 * misfit:.0f} %)" for image, misfit in list(named.items())[:MOST_NAMED])
    more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
    return Findings([f"frames[].light: readings disagree with those under the other lights in {some}{more}: check the direction and "
                     "irradiance of these lights"], named)


def _suspects(sample: Sample, fit: Fit) -> list[Suspect]:
    """Return the lights that disagree with the others on the pixels that fit best, half of those with readings to spare."""
    if not fit.spare.any():
        return []
    left = np.sqrt((fit.residual**2).sum(axis=0) / np.maximum(fit.lit.sum(axis=0), 1))
    sure = fit.spare & (left <= np.median(left[fit.spare]))
    return suspects(grey_readings(sample.radiance, sample.irradiance)[:, sure], sample.directions, fit.normal[:, sure])
