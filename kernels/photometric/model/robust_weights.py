"""Weights of the lights in robust fits.

Fits of reflectance weigh the colour readings of a light together, with one Cauchy weight. What the readings alone decide is written to
scratch memory once, so that the rounds of a fit divide once a light.
"""

from typing import Any

import warp as wp

from kernels.device import once
from kernels.packs import pack_type
from kernels.photometric.model.samples import samples_type, scratch_type

SHADOW_TRUST = 0.1
"""Weight in the fit of a reading that is zero or far below its prediction: such a reading bounds the radiance and hardly measures it."""
LOG_GROUP, LARGEST_SQUARE = 6, 1e6
"""Lights whose 1 + r²/σ² are multiplied before one logarithm is taken, a multiple of 3, and the largest r²/σ²: their product stays in
range."""
WEIGHT_ROWS = 4
"""Values that scratch memory holds for each light: the weight of a reading without misfit, and 1 / σ of each channel over √3."""
ROOT_OF_THIRD = 3.0**-0.5


@wp.struct
class Criteria:
    """Noise, shadows and shape of lobes by which a fit judges readings; `hypotheses.criteria` makes them."""

    noise: wp.vec2  # s0, s1
    shadow: wp.vec2  # r²/σ² of equal cost, depth
    form: wp.vec4  # diffuse roughness, slope, 1.0 for short tails, facets


@wp.func
def weigh(shining: float, expected: float, off2: float, plain: float, shadow: wp.vec2):
    """Return the weight of a light in a robust fit, one for all channels because a shadow is one in each of them, and the exponential of
    its cost.

    `shining` and `expected` are sums over the channels of readings and of predictions, `off2` is the mean r²/σ², `plain` the weight of
    the light without misfit.
    """
    dark = wp.where(shining < shadow[1] * expected, 1, 0) * wp.where(off2 > shadow[0], 1, 0)
    trust = wp.where(shining > 0.0, wp.where(dark == 1, SHADOW_TRUST, 1.0), 1.0)
    given = wp.where(plain > 0.0, 1.0, 0.0)
    return trust * plain / (1.0 + off2), 1.0 + given * wp.min(wp.where(dark == 1, shadow[0], off2), LARGEST_SQUARE)


@wp.func
def weigh_grey(reading: float, predicted: float, off2: float, given: float, sigma: float, shadow: wp.vec2):
    """Return the weight of a grey reading in a robust fit, and the exponential of its cost.

    `off2` is its r²/σ², `sigma` 1 / σ, `given` 1.0 or, where there is no reading, 0.0.
    """
    dark = wp.where(reading < shadow[1] * predicted, 1, 0) * wp.where(off2 > shadow[0], 1, 0)
    trust = wp.where(reading > 0.0, wp.where(dark == 1, SHADOW_TRUST, 1.0), SHADOW_TRUST)
    return given * trust * sigma * sigma / (1.0 + off2), 1.0 + given * wp.where(dark == 1, shadow[0], off2)


@once
def plain_weights(lanes: int) -> Any:
    """Return the Warp function that writes the WEIGHT_ROWS of every light of a pack, as values `row` and those after it."""
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)

    @wp.func
    def write_weights(samples: samples_struct, noise: wp.vec2, p: int, row: int, scratch: scratch_struct):
        bright = samples.level[p]
        for light in range(samples.light_count):
            element = p * samples.pack_stride + light * samples.light_stride
            at = p * scratch.pack_stride + light * scratch.light_stride + row * scratch.step
            shining, value = lane_type(), lane_type()
            for c in range(3):
                y = samples.colour[c, element]
                for k in range(lanes):
                    value[k] = ROOT_OF_THIRD / wp.max(noise[0] * bright[k] + noise[1] * wp.max(y[k], 0.0), 1.0e-20)
                    shining[k] += y[k]
                scratch.values[at + (1 + c) * scratch.step] = value
            for k in range(lanes):
                relative = bright[k] / wp.max(noise[0] * bright[k] + noise[1] * wp.max(shining[k], 0.0) / 3.0, 1.0e-20)
                value[k] = wp.where(shining[k] >= 0.0, wp.where(shining[k] > 0.0, 1.0, SHADOW_TRUST), 0.0) * relative * relative
            scratch.values[at] = value

    return write_weights
