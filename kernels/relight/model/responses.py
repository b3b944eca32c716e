"""The response of a surface to light of energy one from each of many directions: frames are weighted sums of it.

A frame's own samples are shaded by kernels.relight.model.shading. Where many frames light the same surface, what depends on the surface is
computed once here, and what depends on the frame is a matrix product (kernels.relight.frames.combine).

Source: precomputed light transport, Ng, Ramamoorthi and Hanrahan, "All-frequency shadows using non-linear wavelet lighting
approximation", SIGGRAPH 2003, here without wavelets.
"""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.microfacet import INVERSE_PI
from kernels.packs import pack_type
from kernels.relight.model.captured import Captured, images_type
from kernels.relight.model.gloss_ratio import gloss_ratio
from kernels.relight.model.shading import SourcesOnDevice, Surface, lobes, visibility


class Responses(NamedTuple):
    """Responses of a surface to some directions; on CUDA not synchronised."""

    matt: wp.array  # [n, P] float32 packs: visibility · n·l / π; times albedo it is the diffuse part of the radiance
    gloss: wp.array  # [3 n, P] float32 packs: the specular part, R of all directions, then G, then B

    def room(self, count: int, packs: int) -> "Responses":
        """Return the same memory, for the responses of as many packs or fewer to as many directions or fewer."""
        return Responses(*(plane.flatten()[: rows * packs].reshape((rows, packs))
                           for plane, rows in zip(self, (count, 3 * count), strict=True)))


def empty_responses(count: int, packs: int, device: str) -> Responses:
    """Return memory for the responses of some packs to some directions."""
    kind = pack_type(devices.pack_width(device), wp.float32)
    return Responses(*(wp.empty((rows, packs), dtype=kind, device=device) for rows in (count, 3 * count)))


def respond(surface: Surface, sources: SourcesOnDevice, visible: wp.array, responses: Responses) -> None:
    """Compute the responses of a surface to far samples of light, as of energy one, into memory of as many packs as the surface has.

    `visible` is [rows, P] uint8 packs, 255 where a pixel sees the occluder of that row; it has the rows of all samples.
    """
    devices.launch(_respond_kernel(devices.pack_width(surface.device)), responses.matt.size,
                   [surface.values, sources.place, sources.occluder, sources.share, visible], list(responses), device=surface.device)


def shown_gloss(captured: Captured, responses: Responses) -> wp.array:
    """Return [3 lights, P] float32 packs of the specular part under each captured light of irradiance one, as bright as the images show it
    (kernels.relight.model.gloss_ratio); on CUDA not synchronised.
    """
    device = captured.surface.device
    shown = wp.empty(responses.gloss.shape, dtype=responses.gloss.dtype, device=device)
    devices.launch(_shown_kernel(devices.pack_width(device)), responses.matt.size,
                   [captured.images, responses.matt, responses.gloss], [shown], device=device)
    return shown


@once
def _respond_kernel(pack: int) -> Any:
    lane_type, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)
    evaluate, seen = lobes(pack), visibility(pack)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def respond_kernel(first: int,
                       values: wp.array2d(dtype=lane_type),  # [24, P]
                       place: wp.array(dtype=wp.vec4),  # [N]
                       occluder: wp.array(dtype=wp.vec3i),  # [N]
                       share: wp.array(dtype=wp.vec3),  # [N]
                       visible: wp.array2d(dtype=byte_pack),  # [rows, P]
                       # outputs
                       matt: wp.array2d(dtype=lane_type),  # [N, P]
                       gloss: wp.array2d(dtype=lane_type)):  # [3 N, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        n = thread / packs
        p = thread % packs
        facing, shine, _, _ = evaluate(values, p, place[n], wp.vec4())
        lit = seen(visible, p, occluder[n], share[n])
        for k in range(pack):
            facing[k] = INVERSE_PI * lit[k] * facing[k]
        matt[n, p] = facing
        for c in range(3):
            out = lane_type()
            for k in range(pack):
                out[k] = lit[k] * shine[c, k]
            gloss[c * place.shape[0] + n, p] = out

    return respond_kernel


@once
def _shown_kernel(pack: int) -> Any:
    lane_type, images_struct = pack_type(pack, wp.float32), images_type(pack)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def shown_kernel(first: int,
                     images: images_struct,
                     matt: wp.array2d(dtype=lane_type),  # [lights, P]
                     gloss: wp.array2d(dtype=lane_type),  # [3 lights, P]
                     # outputs
                     shown: wp.array2d(dtype=lane_type)):  # [3 lights, P]
        thread = first + wp.tid()
        packs = matt.shape[1]
        light = thread / packs
        p = thread % packs
        diffuse = matt[light, p]
        for c in range(3):
            reading = images.stored[c * images.padded + light, p]
            albedo = images.surface[3 + c, p]
            shine = gloss[c * matt.shape[0] + light, p]
            factor = images.factors[light][c]
            for k in range(pack):
                shine[k] = shine[k] * gloss_ratio(factor * float(reading[k]), albedo[k] * diffuse[k], shine[k])
            shown[c * matt.shape[0] + light, p] = shine

    return shown_kernel
