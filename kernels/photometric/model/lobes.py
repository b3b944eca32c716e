"""Readings that the normal search and the material fit expect under lights of one direction each: Warp functions that their kernels call.

`tabulated_lobes` has the same parts for lights of any extent, looked up in a table, so that one kernel body serves both.
"""

from typing import Any, NamedTuple

import warp as wp

from kernels.device import once
from kernels.microfacet import INVERSE_PI, diffuse, ggx_seen, masking_root, schlick, short_tails
from kernels.packs import pack_type, vector_at
from kernels.photometric.model.samples import samples_type, scratch_type

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
    """Writes the lobes of every light at a candidate normal. Reads the directions of the samples or `table`, and leaves the
    other alone."""


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
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    widths = wp.types.vector(length=len(LOBES), dtype=wp.float32)
    roots = wp.types.matrix(shape=(len(LOBES), lanes), dtype=wp.float32)

    @wp.func
    def prepare(samples: samples_struct, p: int, scratch: scratch_struct):
        vx, vy, vz = vector_at(samples.view, p)
        for light in range(samples.light_count):
            at = p * scratch.pack_stride + light * scratch.light_stride
            element = p * samples.pack_stride + light * samples.light_stride
            wx, wy, wz = vector_at(samples.toward, element)
            inverse, rise = lane_type(), lane_type()
            for k in range(lanes):
                lv = wx[k] * vx[k] + wy[k] * vy[k] + wz[k] * vz[k]
                inverse[k] = 1.0 / wp.sqrt(wp.max(2.0 + 2.0 * lv, 1.0e-6))
                rise[k] = schlick(wp.sqrt(wp.max(0.5 + 0.5 * lv, 0.0)))
            scratch.values[at + wp.static(MIXTURE) * scratch.step] = inverse
            scratch.values[at + wp.static(MIXTURE + 1) * scratch.step] = rise

    @wp.func
    def fill(samples: samples_struct, table: wp.array3d(dtype=float), form: wp.vec4, nx: lane_type, ny: lane_type, nz: lane_type, p: int,
             scratch: scratch_struct):
        vx, vy, vz = vector_at(samples.view, p)
        alphas = widths(wp.static(LOBES[0]), wp.static(LOBES[1]), wp.static(LOBES[2]), wp.static(LOBES[3]), wp.static(LOBES[4]))
        nv, view_root = lane_type(), roots()
        for k in range(lanes):
            nv[k] = nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k]
        for a in range(wp.static(len(LOBES))):
            for k in range(lanes):
                view_root[a, k] = masking_root(nv[k], alphas[a])
        for light in range(samples.light_count):
            element = p * samples.pack_stride + light * samples.light_stride
            lx, ly, lz = vector_at(samples.toward, element)
            at = p * scratch.pack_stride + light * scratch.light_stride
            inverse = scratch.values[at + wp.static(MIXTURE) * scratch.step]
            rise = scratch.values[at + wp.static(MIXTURE + 1) * scratch.step]
            nl, nh, fresnel, lobe = lane_type(), lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                cosine = nx[k] * lx[k] + ny[k] * ly[k] + nz[k] * lz[k]
                nl[k] = wp.max(cosine, 0.0)
                nh[k] = (cosine + nv[k]) * inverse[k]
                fresnel[k] = LOBE_SCALE * (MIXTURE_F0 + (1.0 - MIXTURE_F0) * rise[k])
                lobe[k] = diffuse(nl[k], nv[k], 0.25 / (inverse[k] * inverse[k]), form)
            scratch.values[at] = lobe
            for a in range(wp.static(len(LOBES))):
                width = alphas[a]
                for k in range(lanes):
                    lobe[k] = fresnel[k] * ggx_seen(nl[k], nv[k], nh[k], width, view_root[a, k])
                if form[2] > 0.0:
                    for k in range(lanes):
                        factor, _ = short_tails(nh[k], width)
                        lobe[k] = lobe[k] * factor
                scratch.values[at + (1 + a) * scratch.step] = lobe

    return Lobes(MIXTURE, MIXTURE + GEOMETRY, 1.0, prepare, fill)


@once
def direction_reflectance(lanes: int) -> Reflectance:
    """Return Relit's BRDF under lights of one direction each."""
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)

    @wp.func
    def prepare(samples: samples_struct, table: wp.array3d(dtype=float), form: wp.vec4, nx: lane_type, ny: lane_type, nz: lane_type,
                p: int, scratch: scratch_struct):
        vx, vy, vz = vector_at(samples.view, p)
        nv = lane_type()
        for k in range(lanes):
            nv[k] = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
        for light in range(samples.light_count):
            element = p * samples.pack_stride + light * samples.light_stride
            lx, ly, lz = vector_at(samples.toward, element)
            fd, nl, nh, rise = lane_type(), lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                hv2 = wp.max(0.5 + 0.5 * (lx[k] * vx[k] + ly[k] * vy[k] + lz[k] * vz[k]), 2.5e-7)
                cosine = nx[k] * lx[k] + ny[k] * ly[k] + nz[k] * lz[k]
                hv = wp.sqrt(hv2)
                nl[k] = wp.max(cosine, 0.0)
                nh[k] = (cosine + nv[k]) * 0.5 / hv
                rise[k] = schlick(hv)
                fd[k] = INVERSE_PI * diffuse(nl[k], nv[k], hv2, form)
            at = p * scratch.pack_stride + light * scratch.light_stride
            scratch.values[at] = fd
            scratch.values[at + 3 * scratch.step] = nl
            scratch.values[at + 4 * scratch.step] = nh
            scratch.values[at + 5 * scratch.step] = rise

    @wp.func
    def respond(samples: samples_struct, table: wp.array3d(dtype=float), nx: lane_type, ny: lane_type, nz: lane_type, rough: lane_type,
                p: int, scratch: scratch_struct):
        vx, vy, vz = vector_at(samples.view, p)
        nv, view_root = lane_type(), lane_type()
        for k in range(lanes):
            nv[k] = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
            view_root[k] = masking_root(nv[k], rough[k] * rough[k])
        for light in range(samples.light_count):
            at = p * scratch.pack_stride + light * scratch.light_stride
            nl = scratch.values[at + 3 * scratch.step]
            nh = scratch.values[at + 4 * scratch.step]
            rise = scratch.values[at + 5 * scratch.step]
            for k in range(lanes):
                lobe = ggx_seen(nl[k], nv[k], nh[k], rough[k] * rough[k], view_root[k])
                rise[k] = rise[k] * lobe
                nl[k] = lobe - rise[k]
            scratch.values[at + scratch.step] = nl
            scratch.values[at + 2 * scratch.step] = rise

    @wp.func
    def lambertian(samples: samples_struct, form: wp.vec4, nx: lane_type, ny: lane_type, nz: lane_type, p: int):
        vx, vy, vz = vector_at(samples.view, p)
        above, below, share = lane_type(), lane_type(), lane_type()
        for light in range(samples.light_count):
            at = p * samples.pack_stride + light * samples.light_stride
            wx, wy, wz = vector_at(samples.toward, at)
            for k in range(lanes):
                nv = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
                lv = wx[k] * vx[k] + wy[k] * vy[k] + wz[k] * vz[k]
                nl = wp.max(nx[k] * wx[k] + ny[k] * wy[k] + nz[k] * wz[k], 0.0)
                above[k] += nl * diffuse(nl, nv, wp.max(0.5 + 0.5 * lv, 0.0), form)
                below[k] += nl * nl
        for k in range(lanes):
            share[k] = above[k] / wp.max(below[k], 1.0e-20)
        return share

    return Reflectance(RESPONSES, prepare, respond, lambertian)
