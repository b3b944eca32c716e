"""The small bright lights of many frames on one surface: a few samples a frame, with a highlight and shadows of their own."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.microfacet import INVERSE_PI
from kernels.packs import as_packs, channels_type, pack_type
from kernels.relight.shading import SourcesOnDevice, Surface, lobes, upload_sources, visibility
from kernels.relight.sources import Sources


class FrameSources(NamedTuple):
    """Far samples of several frames on a device."""

    samples: SourcesOnDevice
    first: wp.array  # [frames + 1] int32: where the samples of each frame begin


def upload_frames(sources: Sources, counts: Sequence[int], device: str) -> FrameSources:
    """Put the far samples of frames on the device.

    Args:
        sources: all samples, those of the first frame first.
        counts: number of samples of each frame.
        device: where.

    Raises:
        ArrayError: counts of other samples, or a near one.
    """
    if sum(counts) != sources.count or sources.place[:, 3].any():
        raise ArrayError(f"samples are {sources.count}, {int(sources.place[:, 3].sum())} of them near, for frames of {sum(counts)}: "
                         "give the far samples of all frames")
    first = np.concatenate([[0], np.cumsum(counts)])
    return FrameSources(upload_sources(sources, device), wp.array(first, dtype=wp.int32, device=device))


def shade_frames(surface: Surface, frames: FrameSources, visible: wp.array) -> wp.array:
    """Return the radiance of a surface under the samples of each frame.

    Args:
        surface: the pixels.
        frames: the samples.
        visible: [rows, P] uint8 packs, 255 where a pixel sees the occluder of that row; it has the rows of all samples.

    Returns:
        [frames, 6, pixels padded] float32, of each frame diffuse RGB and specular RGB; not synchronised on CUDA.
    """
    pack, count, device = devices.pack_width(surface.device), len(frames.first) - 1, surface.device
    out = wp.empty((count, 6, surface.packs * pack), dtype=wp.float32, device=device)
    samples = frames.samples
    devices.launch(_frames_kernel(pack), count * surface.packs,
                   [surface.values, samples.place, samples.energy, samples.occluder, samples.share, frames.first, visible],
                   [as_packs(out, device)], device=device)
    return out


@cache
def _frames_kernel(pack: int) -> Any:
    lane_type, byte_pack, channels = pack_type(pack, wp.float32), pack_type(pack, wp.uint8), channels_type(pack)
    evaluate, seen = lobes(pack), visibility(pack)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def frames_kernel(first: int,
                      values: wp.array2d(dtype=lane_type),  # [24, P]
                      place: wp.array(dtype=wp.vec4),  # [N]
                      energy: wp.array(dtype=wp.vec3),  # [N]
                      occluder: wp.array(dtype=wp.vec3i),  # [N]
                      share: wp.array(dtype=wp.vec3),  # [N]
                      begin: wp.array(dtype=wp.int32),  # [frames + 1]
                      visible: wp.array2d(dtype=byte_pack),  # [rows, P]
                      # outputs
                      out: wp.array3d(dtype=lane_type)):  # [frames, 6, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        f = thread / packs
        p = thread % packs
        matt, glossy = channels(), channels()
        for n in range(begin[f], begin[f + 1]):
            facing, gloss, _, _ = evaluate(values, p, place[n], wp.vec4())
            lit = seen(visible, p, occluder[n], share[n])
            for c in range(3):
                e = energy[n][c]
                for k in range(pack):
                    matt[c, k] += e * (lit[k] * facing[k])
                    glossy[c, k] += e * (lit[k] * gloss[c, k])
        for c in range(3):
            albedo = values[3 + c, p]
            for k in range(pack):
                matt[c, k] = albedo[k] * INVERSE_PI * matt[c, k]
            out[f, c, p] = matt[c]
            out[f, 3 + c, p] = glossy[c]

    return frames_kernel
