"""Frames on a CUDA device, corrected there by what a model of the surface says they miss.

The arithmetic is that of service.relight.model_range.correction, a frame and a pixel at a time, so that neither the frames nor the sums of
the model go through the host.
"""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import as_packs, pack_type
from kernels.relight.model.gloss_ratio import mean_ratio


class FramesOnDevice(NamedTuple):
    """Linear frames of a chunk on a device."""

    radiance: wp.array  # [frames, 3, pixels of the image] float32
    specular: wp.array  # the same of their specular part; [0, 3, pixels] where it is not wanted


class FrameSums(NamedTuple):
    """The model of some pixels, summed for frames: [frames, 3, pixels padded] float32, or [0, 3, …] where frames have nothing of a kind.

    Parts that are `matt` lack the albedo.
    """

    matt: wp.array
    gloss: wp.array
    told: wp.array
    """Diffuse part of what the weighted sum of images contains."""
    shown: wp.array
    """Its specular part, as bright as the images show it."""
    shown_given: wp.array
    """The same of lights that the sum adds, without those that it takes away."""
    gloss_given: wp.array
    """The same as the model has it."""
    added_matt: wp.array
    added_gloss: wp.array
    beyond_matt: wp.array
    beyond_gloss: wp.array
    beyond_small: wp.array  # [frames, 6, …], with the albedo, diffuse and specular
    inside_matt: wp.array
    inside_gloss: wp.array


class Pixels(NamedTuple):
    """The pixels of a portion on a device."""

    values: wp.array  # [24, P] float packs of their surface
    position: wp.array  # [n] int32 in the image
    trust: wp.array  # [n] float32
    trust_beyond: wp.array  # [n] float32; [0] where nothing lies beyond the captured lights
    least_beyond: float
    """The least trust there in what the model takes away (kernels.relight.model.beyond.trusted)."""


def correct_frames(frames: FramesOnDevice, places: wp.array, begin: int, sums: FrameSums, small: wp.array, pixels: Pixels) -> None:
    """Correct some neighbouring frames at the pixels of a portion; not synchronised.

    Args:
        places: [frames of `sums`] int32: which of the frames each is.
        begin: number, in `sums`, of the first frame that is corrected.
        small: [frames, 6, pixels padded] float32 of their small lights, diffuse and specular; as many frames are corrected.
    """
    device = pixels.values.device.alias
    devices.launch(_correct_kernel(devices.pack_width(device)), small.shape[0] * pixels.values.shape[1],
                   [begin, places, *pixels, *(as_packs(each, device) for each in (small, *sums))], list(frames), device=device)


@once
def _correct_kernel(pack: int) -> Any:
    lane_type = pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def correct_kernel(first: int,
                       begin: int,
                       places: wp.array(dtype=wp.int32),  # [F]
                       values: wp.array2d(dtype=lane_type),  # [24, P]
                       position: wp.array(dtype=wp.int32),  # [n]
                       trust: wp.array(dtype=float),  # [n]
                       trust_beyond: wp.array(dtype=float),  # [n] or [0]
                       least_beyond: float,
                       small: wp.array3d(dtype=lane_type),  # [F, 6, P], as the following that are not empty
                       matt: wp.array3d(dtype=lane_type),
                       gloss: wp.array3d(dtype=lane_type),
                       told: wp.array3d(dtype=lane_type),
                       shown: wp.array3d(dtype=lane_type),
                       shown_given: wp.array3d(dtype=lane_type),
                       gloss_given: wp.array3d(dtype=lane_type),
                       added_matt: wp.array3d(dtype=lane_type),
                       added_gloss: wp.array3d(dtype=lane_type),
                       beyond_matt: wp.array3d(dtype=lane_type),
                       beyond_gloss: wp.array3d(dtype=lane_type),
                       beyond_small: wp.array3d(dtype=lane_type),
                       inside_matt: wp.array3d(dtype=lane_type),
                       inside_gloss: wp.array3d(dtype=lane_type),
                       # outputs
                       frames: wp.array3d(dtype=float),  # [frames, 3, N]
                       specular: wp.array3d(dtype=float)):  # [frames, 3, N] or [0, 3, N]
        thread = first + wp.tid()
        packs = values.shape[1]
        s, p = thread / packs, thread % packs
        f = begin + s
        row = places[f]
        for c in range(3):
            albedo = values[3 + c, p]
            for k in range(pack):
                n = p * pack + k
                if n < position.shape[0]:
                    at = position[n]
                    plain = frames[row, c, at]
                    ratio = mean_ratio(shown_given[f, c, p][k], gloss_given[f, c, p][k])
                    mirror = (gloss[f, c, p][k] + small[s, 3 + c, p][k]) * ratio
                    whole = albedo[k] * told[f, c, p][k] + shown[f, c, p][k]
                    added, added_mirror = float(0.0), float(0.0)
                    if added_matt.shape[0] > 0:
                        added_mirror = added_gloss[f, c, p][k]
                        added = albedo[k] * added_matt[f, c, p][k] + added_mirror
                    inside = float(0.0)
                    if beyond_matt.shape[0] > 0:
                        inside = albedo[k] * inside_matt[f, c, p][k] + inside_gloss[f, c, p][k]
                    picture = inside + wp.max(whole, 0.0) + added
                    share = wp.where(picture > 0.0, wp.max(plain / picture, 0.0), 0.0)
                    gain = albedo[k] * matt[f, c, p][k] + small[s, c, p][k] + mirror - whole
                    change = trust[n] * wp.where(gain < 0.0, gain * wp.min(share, 1.0), gain)
                    if beyond_matt.shape[0] > 0:
                        shine = beyond_gloss[f, c, p][k] + beyond_small[f, 3 + c, p][k]
                        outside = albedo[k] * beyond_matt[f, c, p][k] + beyond_small[f, c, p][k] + shine
                        gain = outside - inside
                        believed = trust_beyond[n]
                        change += wp.where(gain < 0.0, wp.max(believed, least_beyond) * gain * share, believed * gain)
                        mirror += shine
                    guided = wp.max(plain + change, wp.min(plain, 0.0))
                    frames[row, c, at] = guided
                    if specular.shape[0] > 0:
                        specular[row, c, at] = wp.clamp(mirror + added_mirror, 0.0, wp.max(guided, 0.0))

    return correct_kernel
