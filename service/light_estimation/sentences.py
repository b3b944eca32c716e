"""Sentences about what explains the images of a capture better than its manifest."""

import numpy as np

from service.light_estimation.encodings import ENCODINGS
from service.light_estimation.explanations import Cause, Explanation, Sample


def explanation_sentence(found: Explanation, sample: Sample) -> str:
    """Return the sentence for what explains the images better than the manifest."""
    fits = f"the readings then fit to {100 * found.left:.1f} %, as declared to {100 * found.misfit:.1f} %"
    alike = " (every light is declared alike)" if np.ptp(sample.irradiance, axis=0).max() < 1e-6 * sample.irradiance.max() else ""
    measure = "`relit calibrate intensity` measures it"
    return {
        Cause.ENCODED: f"color_space: the images look display-encoded, but {sample.color_space} is declared: decoded as "
                       f"{ENCODINGS.get(found.space)}, {fits}; "
                       f"declare {found.space} if they are",
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
        Cause.SHIFTED: f"frames[].light: the lights look one frame off: with each light one image earlier or later, {fits}; check which "
                       "light belongs to which image",
        Cause.DIRECTIONS: f"frames[].light.direction: images and directions do not belong together: with other directions, {fits}; "
                          "check which light belongs to which image, and the directions",
    }[found.cause]
