"""What images say against the lights and the encoding that their manifest declares, for products that sum images and solve nothing."""

import numpy as np

from kernels.photometric.model.samples import evenly
from service.light_estimation.dark_lights import dark_frames, dark_sentence
from service.light_estimation.explanations import (
    MIN_LIGHTS,
    PIXELS,
    Sample,
    better_explanation,
    explanation_sentence,
    fit_manifest,
    grey_readings,
)
from service.light_estimation.lambertian import Fit
from service.light_estimation.light_axes import Grid, axes_sentence
from stage.capture.capture import Capture
from stage.capture.light import DistantLight
from stage.capture.lighting import has_placeholders
from stage.capture.point_lights import DistantLights
from stage.stack.stack import Stack

LEFT_IN = "light from there is missing; take them again, or out of the frames"
"""What is done about dark frames where images are summed."""


def sample_of(stack: Stack, capture: Capture, lights: DistantLights, mask: np.ndarray) -> Sample:
    """Return some pixels of a stack with what the manifest says of them. `lights`: those of the stack. `mask`: [rows, cols] bool."""
    inside = np.flatnonzero(mask)
    radiance, usable = stack.pick_radiance(inside[evenly(len(inside), PIXELS)])
    times = {frame.image: frame.exposure_s or 1.0 for frame in capture.sources()}
    exposure = np.array([times[image] for image in stack.frames])
    return Sample(radiance, usable, lights.direction, lights.irradiance, exposure, capture.manifest.color_space, tuple(stack.frames))


def facing_sentence(fit: Fit) -> str | None:
    """Return a sentence about directions under which what the camera sees would face away from it, or None."""
    towards = fit.towards_camera
    if towards is None:
        return None
    sign = "-" if towards.sign < 0 else ""
    return (f"frames[].light.direction: {100 * (1 - fit.facing):.0f} % of the surface would face away from the camera that sees it: with "
            f"{sign}{'xyz'[towards.axis]} as the axis towards the camera, {100 * towards.share:.0f} % face it; check the axes (x right, y "
            "up, z towards the camera), and that directions point to the light")


def declared_light_sentences(stack: Stack, capture: Capture, lights: DistantLights, mask: np.ndarray) -> list[str]:
    """Return a sentence for what the images of a stack contradict: directions, dark frames, encoding, brightness, order or axes of the
    lights. `lights`: those of the stack, near ones as distant ones; only dark frames are told of these. `mask`: [rows, cols] bool, the
    object."""
    judged = len(capture.lit_by(DistantLight)) == len(capture.sources()) and not capture.is_polarised and not has_placeholders(capture)
    fit = None
    if judged and len(lights.direction) >= MIN_LIGHTS and mask.any():
        sample = sample_of(stack, capture, lights, mask)
        fit = fit_manifest(sample)
        if (away := facing_sentence(fit)) is not None:
            return [away]
    if (dark := dark_frames(stack, lights, mask)).any():
        return [dark_sentence(stack.frames, dark, LEFT_IN)]
    if fit is None:
        return []
    if (found := better_explanation(sample, fit)) is not None:
        return [explanation_sentence(found, sample)]
    radiance, usable = stack.pick_radiance((grid := Grid.of(mask)).chosen)
    axes = axes_sentence(capture.camera, grid, grey_readings(radiance, lights.irradiance), usable, lights.direction)
    return [] if axes is None else [axes]
