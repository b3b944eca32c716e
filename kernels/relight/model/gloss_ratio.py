"""The model under the captured lights, with its gloss as bright as the images show it.

What a captured image has beyond the model is added to frames between the lights, because scattering and interreflection change slowly. A
highlight does not: what the model misses of it would stay where the captured light had it, as a ghost beside the frame's own highlight.
So the specular part is taken as a ratio: under each captured light, it is scaled by the ratio of image to model, and the frame's
specular part by the mean of these ratios, each weighted by the light's part in the frame times its specular part. A frame under a captured
light remains the captured image.

Source: brightness as a ratio to that of an image under other light, Shashua and Riklin-Raviv, "The quotient image", TPAMI 2001.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels.device import once, to_numpy
from kernels.errors import ArrayError
from kernels.microfacet import INVERSE_PI
from kernels.packs import channels_type, pack_type
from kernels.relight.model.captured import Captured, images_type
from kernels.relight.model.shading import lobes

MOST_RATIO = 1.25
"""Largest ratio of image to model that the gloss is scaled by; what is brighter stays a difference. On the flank of a lobe that is
too wide, the ratio says little of the peak: unbounded, it makes sharp highlights half as bright again as they are."""

LEAST_GLOSS = 1.0e-9
"""Radiance of a specular part below which there is none, and the ratio is 1."""


class ShownModel(NamedTuple):
    """The model under the captured lights, summed for one frame, with its gloss as bright as the images show it."""

    whole: np.ndarray  # [3, n] diffuse and scaled specular part
    ratio: np.ndarray  # [3, n] mean ratio of image to model, 0…MOST_RATIO; 1 where no light of the frame gives gloss


@wp.func
def gloss_ratio(reading: float, matt: float, gloss: float) -> float:
    """Return what the specular part of one channel is scaled by under a light, from readings of the image and the model's two parts."""
    whole = matt + gloss
    return wp.where(whole > 1.0e-9, wp.clamp(reading / wp.max(whole, 1.0e-9), 0.0, MOST_RATIO), 1.0)


@wp.func
def mean_ratio(shown: float, gloss: float) -> float:
    """Return the mean of ratios from sums of the scaled specular part and of the specular part."""
    return wp.where(gloss > LEAST_GLOSS, shown / wp.max(gloss, LEAST_GLOSS), 1.0)


def ratio_of_sums(shown: np.ndarray, gloss: np.ndarray) -> np.ndarray:
    """Return the mean of ratios from sums of the scaled specular part and of the specular part, both […], as mean_ratio does."""
    return np.divide(shown, gloss, out=np.ones_like(shown), where=gloss > LEAST_GLOSS)


def sum_shown(captured: Captured, energy: np.ndarray) -> ShownModel:
    """Sum the model under the captured lights for one frame, which gives them energy [lights, 3], also negative; waits for the device."""
    surface, count = captured.surface, len(captured.direction)
    if np.shape(energy) != (count, 3):
        raise ArrayError(f"energy is {np.shape(energy)}: give {(count, 3)}")
    used = np.flatnonzero(np.abs(energy).max(axis=1, initial=0) > 0).astype(np.int32)
    sums = captured.sums(_sum_kernel, 6, wp.array(energy, dtype=wp.vec3, device=surface.device),
                         wp.array(used, dtype=wp.int32, device=surface.device))
    whole, ratio = to_numpy(sums)[:, : surface.pixel_count].reshape(2, 3, -1)
    return ShownModel(whole, ratio)


@once
def _sum_kernel(pack: int) -> Any:
    lane_type, images_struct, channels, evaluate = pack_type(pack, wp.float32), images_type(pack), channels_type(pack), lobes(pack)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def sum_kernel(first: int,
                   images: images_struct,
                   energy: wp.array(dtype=wp.vec3),  # [lights]
                   used: wp.array(dtype=wp.int32),  # lights with energy
                   # outputs
                   sums: wp.array2d(dtype=lane_type)):  # [6, P]
        p = first + wp.tid()
        whole, shown, shone = channels(), channels(), channels()
        for n in range(used.shape[0]):
            light = used[n]
            facing, gloss, _, _ = evaluate(images.surface, p, images.places[light], wp.vec4())
            lit = images.visible[light, p]
            for c in range(3):
                albedo = images.surface[3 + c, p]
                reading = images.stored[c * images.padded + light, p]
                given, factor = energy[light][c], images.factors[light][c]
                for k in range(pack):
                    seen = float(lit[k]) * wp.static(1.0 / 255.0)
                    matt = seen * albedo[k] * INVERSE_PI * facing[k]
                    shine = seen * gloss[c, k]
                    scaled = shine * gloss_ratio(factor * float(reading[k]), matt, shine)
                    whole[c, k] += given * (matt + scaled)
                    shown[c, k] += wp.max(given, 0.0) * scaled
                    shone[c, k] += wp.max(given, 0.0) * shine
        for c in range(3):
            one, other = lane_type(), lane_type()
            for k in range(pack):
                one[k] = whole[c, k]
                other[k] = mean_ratio(shown[c, k], shone[c, k])
            sums[c, p] = one
            sums[3 + c, p] = other

    return sum_kernel
