"""What images say against the lights and the encoding that their manifest declares, for products that sum images and solve nothing."""

import numpy as np

from kernels.photometric.model.samples import some_of
from service.light_estimation.dark_lights import dark_frames, dark_sentence
from service.light_estimation.explanations import (
    MIN_LIGHTS,
    PIXELS,
    Cause,
    Explanation,
    Sample,
    better_explanation,
    fit_manifest,
    grey_readings,
)
from service.light_estimation.grey_ball import ENCODINGS
from service.light_estimation.lambertian import Fit
from service.light_estimation.light_axes import Grid, axes_sentence
from stage.capture.capture import Capture
from stage.capture.light import DistantLight
from stage.capture.lighting import has_placeholders
from stage.capture.point_lights import DistantLights
from stage.stack.stack import Stack

LEFT_IN = "light from there is missing; take them again, or out of the frames"
"""What is done about dark frames where images are summed."""


def sampled(mask: np.ndarray) -> np.ndarray:
    """Return the positions of the pixels of a sample."""
    return some_of(mask, PIXELS)


def sample_of(stack: Stack, capture: Capture, lights: DistantLights, mask: np.ndarray) -> Sample:
    """Return some pixels of a stack with what the manifest says of them. `lights`: those of the stack. `mask`: [rows, cols] bool."""
    radiance, usable = stack.pick_radiance(sampled(mask))
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


def explanation_sentence(found: Explanation, sample: Sample) -> str:
    """Return the sentence for what explains the images better than the manifest."""
    fits = f"the readings then fit to {100 * found.left:.1f} %, as declared to {100 * found.misfit:.1f} %"
    alike = " (every light is declared alike)" if np.ptp(sample.irradiance, axis=0).max() < 1e-6 * sample.irradiance.max() else ""
    measure = "`relit calibrate intensity` measures it"
    if found.step is not None:
        return (f"frames[].light.irradiance: from {sample.images[found.step.first]} on, all images look {found.step.factor:.2g} times as "
                f"bright as declared beside those before it, as where exposure, gain or lamps changed there; give exposure_s, or the "
                f"irradiance of these lights ({measure})")
    if found.late is not None:
        first, ahead = sample.images[found.late[0]], found.late[1] > 0
        return (f"frames[].light: from {first} on, the images look one light {'ahead of' if ahead else 'behind'} the manifest, as where a "
                f"picture was {'lost' if ahead else 'taken twice'}: with each light one image {'earlier' if ahead else 'later'} there, "
                f"{fits}; check which light belongs to which image from there on")
    if found.gloss:
        return (f"color_space: the images look linear, and {sample.color_space} is declared, or a broad highlight lies over the object: "
                f"nothing tells them apart under lights so near to where it faces (taken as linear, {fits}); check color_space")
    return {
        Cause.ENCODED: f"color_space: the images look display-encoded, but {sample.color_space} is declared: decoded as "
                       f"{ENCODINGS.get(found.space)}, {fits}; declare {found.space} if they are",
        Cause.LINEAR: f"color_space: the images look linear, but {sample.color_space} is declared: taken as linear, {fits}; declare a "
                      "linear space, such as lin_rec709_scene",
        Cause.IRRADIANCE: f"frames[].light.irradiance: it is missing or wrong{alike}: with the brightness that the images ask for, "
                          f"{fits}; {measure} (a missing exposure_s, and near lights that are declared distant, act alike)",
        Cause.ENCODED_OR_IRRADIANCE: f"color_space or frames[].light.irradiance: the images look display-encoded, or the irradiance is "
                                     f"missing or wrong{alike}: {fits}; declare {found.space} if they are encoded, else {measure}",
        Cause.NORMALISED: f"frames[].light.irradiance: the images look as if they were divided by it already: with equal lights, {fits}; "
                          "declare the same irradiance for every light",
        Cause.REVERSED: f"frames[].light: the order looks reversed: with the lights from last to first, {fits}; check which light "
                        "belongs to which image",
        Cause.TEXT: f"frames[].light: images and lights look sorted otherwise, one of them by their numbers as text (1, 10, 11, 2): sorted "
                    f"alike, {fits}; check which light belongs to which image, as by numbers of as many digits (01, 02)",
        Cause.SHIFTED: f"frames[].light: the lights look one frame off: with each light one image earlier or later, {fits}; check which "
                       "light belongs to which image",
        Cause.BALL_NORMALS: "frames[].light.direction: the directions look like normals of a mirror ball at the spots of the lamps, which "
                            f"are half way to the viewer: with n taken as 2 (n·v) n - v, {fits}; correct the table, or measure the lights "
                            "(relit calibrate mirror-ball)",
        Cause.ELEVATION: "frames[].light.direction: elevations look exchanged with angles from the view axis: with 90° less each of them, "
                         f"{fits}; correct the table",
        Cause.DIRECTIONS: f"frames[].light.direction: images and directions do not belong together: with other directions, {fits}; "
                          "check which light belongs to which image, the directions, and that all have one exposure (camera on manual)",
        Cause.STEADY: f"frames: the images look to share light that is not that of their lamps, {100 * found.part:.0f} % of what a lamp "
                      f"gives that a pixel faces, as light of the room or a black level: without it, {fits}; add an image with all lamps "
                      "off as a frame of light off, or give dark",
    }[found.cause]


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
