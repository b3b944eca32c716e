"""Readings that the normal search and the material fit expect under lights of one direction each: Warp functions that their kernels call.

`tabulated_lobes` has the same parts for lights of any extent, looked up in a table, so that one kernel body serves both.
"""

from typing import Any, NamedTuple

import warp as wp

from kernels.device import once
from kernels.microfacet import INVERSE_PI, diffuse, ggx_seen, masking_root, schlick
from kernels.packs import pack_type

LOBES = (0.08, 0.15, 0.25, 0.4, 0.6)
"""Widths α of the GGX lobes of the mixture: roughness 0.28 to 0.77, a factor of 1.5 to 2 apart, as wide as the lobes are."""
MIXTURE = 1 + len(LOBES)
"""Number of lobes in the mixture: the diffuse one and the GGX lobes."""
MIXTURE_F0 = 0.04
"""Reflectance at normal incidence that the Fresnel rise of the lobes assumes: readings at grazing half vectors hardly depend on it."""
LOBE_SCALE = 0.1 / MIXTURE_F0
"""Scale of the GGX lobes relative to the diffuse one, chosen so that their weights are of one order of magnitude."""
GEOMETRY = 2
"""Number of values that the scratch memory holds for each light besides the lobes: 1 / |l + v| and (1 - h·v)⁵."""

RESPONSES = 6
"""Number of values that the scratch memory of the material fit holds for each light: its three responses, n·l, n·h and (1 - h·v)⁵."""


class Lobes(NamedTuple):
    """Expected readings as the search takes them: Warp functions that write them to scratch, [light][held values]."""

    count: int
    """Lobes of the mixture, the diffuse one first."""
    held: int
    """Values of a light in scratch: its lobes, and what `prepare` keeps there."""
    relaxation: float
    """Over-relaxation of the non-negative solve: above one where lobes are much alike."""
    prepare: Any
    """Writes what depends on light and view alone."""
    fill: Any
    """Writes the lobes of every light at a candidate normal. Reads `toward` or `table`, and leaves the other alone."""


class Reflectance(NamedTuple):
    """Expected readings as the material fit takes them: Warp functions that write them to scratch, [light][held values]. The first three
    values are the diffuse response to an albedo of one, the specular response to F0, and what of it does not depend on F0."""

    held: int
    """Values of a light in scratch."""
    prepare: Any
    """Writes the diffuse response of every light at a normal, and what `respond` needs beside it."""
    respond: Any
    """Writes the specular responses of every light at a roughness."""
    lambertian: Any
    """Albedo of the closest Lambertian lobe, for a fitted albedo of one."""


@once
def direction_lobes(lanes: int) -> Lobes:
    """Return the mixture of lobes under lights of one direction each."""
    lane_type = pack_type(lanes, wp.float32)
    widths = wp.types.vector(length=len(LOBES), dtype=wp.float32)
    roots = wp.types.matrix(shape=(len(LOBES), lanes), dtype=wp.float32)

    @wp.func
    def prepare(toward: wp.array2d(dtype=lane_type), vx: lane_type, vy: lane_type, vz: lane_type, start: int, light_count: int,
                light_stride: int, base: int, step: int, scratch: wp.array(dtype=lane_type)):
        for light in range(light_count):
            at = base + light * wp.static(MIXTURE + GEOMETRY) * step
            element = start + light * light_stride
            wx = toward[0, element]
            wy = toward[1, element]
            wz = toward[2, element]
            inverse, rise = lane_type(), lane_type()
            for k in range(lanes):
                lv = wx[k] * vx[k] + wy[k] * vy[k] + wz[k] * vz[k]
                inverse[k] = 1.0 / wp.sqrt(wp.max(2.0 + 2.0 * lv, 1.0e-6))
                rise[k] = schlick(wp.sqrt(wp.max(0.5 + 0.5 * lv, 0.0)))
            scratch[at + wp.static(MIXTURE) * step] = inverse
            scratch[at + wp.static(MIXTURE + 1) * step] = rise

    @wp.func
    def fill(toward: wp.array2d(dtype=lane_type), table: wp.array3d(dtype=float), form: wp.vec2,
             nx: lane_type, ny: lane_type, nz: lane_type, vx: lane_type, vy: lane_type, vz: lane_type, start: int,
             light_count: int, light_stride: int, base: int, step: int, scratch: wp.array(dtype=lane_type)):
        alphas = widths(wp.static(LOBES[0]), wp.static(LOBES[1]), wp.static(LOBES[2]), wp.static(LOBES[3]), wp.static(LOBES[4]))
        nv, view_root = lane_type(), roots()
        for k in range(lanes):
            nv[k] = nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k]
        for a in range(wp.static(len(LOBES))):
            for k in range(lanes):
                view_root[a, k] = masking_root(nv[k], alphas[a])
        for light in range(light_count):
            element = start + light * light_stride
            lx = toward[0, element]
            ly = toward[1, element]
            lz = toward[2, element]
            at = base + light * wp.static(MIXTURE + GEOMETRY) * step
            inverse = scratch[at + wp.static(MIXTURE) * step]
            rise = scratch[at + wp.static(MIXTURE + 1) * step]
            nl, nh, fresnel, lobe = lane_type(), lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                cosine = nx[k] * lx[k] + ny[k] * ly[k] + nz[k] * lz[k]
                nl[k] = wp.max(cosine, 0.0)
                nh[k] = (cosine + nv[k]) * inverse[k]
                fresnel[k] = LOBE_SCALE * (MIXTURE_F0 + (1.0 - MIXTURE_F0) * rise[k])
                lobe[k] = diffuse(nl[k], nv[k], 0.25 / (inverse[k] * inverse[k]), form[0], form[1])
            scratch[at] = lobe
            for a in range(wp.static(len(LOBES))):
                width = alphas[a]
                for k in range(lanes):
                    lobe[k] = fresnel[k] * ggx_seen(nl[k], nv[k], nh[k], width, view_root[a, k])
                scratch[at + (1 + a) * step] = lobe

    return Lobes(MIXTURE, MIXTURE + GEOMETRY, 1.0, prepare, fill)


@once
def direction_reflectance(lanes: int) -> Reflectance:
    """Return Relit's BRDF under lights of one direction each."""
    lane_type = pack_type(lanes, wp.float32)

    @wp.func
    def prepare(toward: wp.array2d(dtype=lane_type), table: wp.array3d(dtype=float), form: wp.vec2,
                nx: lane_type, ny: lane_type, nz: lane_type, vx: lane_type, vy: lane_type, vz: lane_type, start: int,
                light_count: int, light_stride: int, base: int, light_step: int, step: int, scratch: wp.array(dtype=lane_type)):
        nv = lane_type()
        for k in range(lanes):
            nv[k] = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
        for light in range(light_count):
            element = start + light * light_stride
            lx = toward[0, element]
            ly = toward[1, element]
            lz = toward[2, element]
            fd, nl, nh, rise = lane_type(), lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                hv2 = wp.max(0.5 + 0.5 * (lx[k] * vx[k] + ly[k] * vy[k] + lz[k] * vz[k]), 2.5e-7)
                cosine = nx[k] * lx[k] + ny[k] * ly[k] + nz[k] * lz[k]
                hv = wp.sqrt(hv2)
                nl[k] = wp.max(cosine, 0.0)
                nh[k] = (cosine + nv[k]) * 0.5 / hv
                rise[k] = schlick(hv)
                fd[k] = INVERSE_PI * diffuse(nl[k], nv[k], hv2, form[0], form[1])
            at = base + light * light_step
            scratch[at] = fd
            scratch[at + 3 * step] = nl
            scratch[at + 4 * step] = nh
            scratch[at + 5 * step] = rise

    @wp.func
    def respond(table: wp.array3d(dtype=float),
                nx: lane_type, ny: lane_type, nz: lane_type, vx: lane_type, vy: lane_type, vz: lane_type, rough: lane_type,
                light_count: int, base: int, light_step: int, step: int, scratch: wp.array(dtype=lane_type)):
        nv, view_root = lane_type(), lane_type()
        for k in range(lanes):
            nv[k] = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
            view_root[k] = masking_root(nv[k], rough[k] * rough[k])
        for light in range(light_count):
            at = base + light * light_step
            nl = scratch[at + 3 * step]
            nh = scratch[at + 4 * step]
            rise = scratch[at + 5 * step]
            for k in range(lanes):
                lobe = ggx_seen(nl[k], nv[k], nh[k], rough[k] * rough[k], view_root[k])
                rise[k] = rise[k] * lobe
                nl[k] = lobe - rise[k]
            scratch[at + step] = nl
            scratch[at + 2 * step] = rise

    @wp.func
    def lambertian(toward: wp.array2d(dtype=lane_type), form: wp.vec2,
                   nx: lane_type, ny: lane_type, nz: lane_type, vx: lane_type, vy: lane_type, vz: lane_type, start: int,
                   light_count: int, light_stride: int):
        above, below, share = lane_type(), lane_type(), lane_type()
        for light in range(light_count):
            at = start + light * light_stride
            wx = toward[0, at]
            wy = toward[1, at]
            wz = toward[2, at]
            for k in range(lanes):
                nv = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
                lv = wx[k] * vx[k] + wy[k] * vy[k] + wz[k] * vz[k]
                nl = wp.max(nx[k] * wx[k] + ny[k] * wy[k] + nz[k] * wz[k], 0.0)
                above[k] += nl * diffuse(nl, nv, wp.max(0.5 + 0.5 * lv, 0.0), form[0], form[1])
                below[k] += nl * nl
        for k in range(lanes):
            share[k] = above[k] / wp.max(below[k], 1.0e-20)
        return share

    return Reflectance(RESPONSES, prepare, respond, lambertian)
