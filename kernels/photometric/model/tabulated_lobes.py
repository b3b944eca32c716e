"""The lobes of the search and of the material fit looked up in a response table: for lights of any extent.

The table is for the view z. A pixel that is seen from elsewhere, v, looks the diffuse lobe up at its normal and the others at
the normal that reflects z to where its own reflects v: exact for a mirror, and to first order in the angle between v and z for
any lobe.
"""

import math
from typing import Literal

import warp as wp

from kernels.device import once
from kernels.packs import pack_type, vector_at
from kernels.photometric.model.lobes import Lobes, Reflectance
from kernels.photometric.model.response_table import (
    GRID,
    LEAST_NZ,
    MIRROR_ALPHA,
    NARROWEST,
    SEARCH_LOBES,
    SEARCH_WIDTHS,
    WIDTH_COUNT,
    WIDTH_RATIO,
    grid_position,
)
from kernels.photometric.model.samples import samples_type, scratch_type

RELAXATION = 1.6
"""Over-relaxation of the non-negative solve: lobes integrated over wide lights are much alike, and plain sweeps would converge slowly."""
LOG_MIRROR, LOG_NARROWEST, LOG_RATIO = math.log(MIRROR_ALPHA), math.log(NARROWEST), math.log(WIDTH_RATIO)
"""Natural logarithms of the mirror's width, of the narrowest width of the table and of the ratio between two widths."""


@wp.func
def reflecting_normal(n: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return the normal that reflects the table's view to where n reflects v."""
    r = 2.0 * wp.dot(n, v) * n - v
    return wp.normalize(wp.vec3(r[0], r[1], wp.max(r[2] + 1.0, LEAST_NZ)))


@wp.func
def look_up(table: wp.array3d(dtype=float), place: wp.vec2, light: int, column: int) -> float:
    """Return one column of the table at a place among its nodes, interpolated bilinearly."""
    i = wp.clamp(int(place[0]), 0, wp.static(GRID - 2))
    j = wp.clamp(int(place[1]), 0, wp.static(GRID - 2))
    a = place[0] - float(i)
    b = place[1] - float(j)
    cell = i * GRID + j
    low = (1.0 - b) * table[cell, light, column] + b * table[cell + 1, light, column]
    high = (1.0 - b) * table[cell + GRID, light, column] + b * table[cell + wp.static(GRID + 1), light, column]
    return (1.0 - a) * low + a * high


@wp.func
def width_position(roughness: float) -> float:
    """Return where a roughness lies among the widths of the table: 0 the mirror, 1 the narrowest GGX lobe; linear in log α between."""
    width = 2.0 * wp.log(wp.max(roughness, 1.0e-3))
    above = 1.0 + (width - LOG_NARROWEST) / LOG_RATIO
    below = (width - LOG_MIRROR) / wp.static(LOG_NARROWEST - LOG_MIRROR)
    return wp.clamp(wp.where(above >= 1.0, above, below), 0.0, float(WIDTH_COUNT))


@once
def tabulated_lobes(lanes: int, count: Literal[2 + len(SEARCH_WIDTHS), SEARCH_LOBES]) -> Lobes:
    """Return the mixture of a search table of `count` lobes."""
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    pairs = wp.types.matrix(shape=(4, lanes), dtype=wp.float32)

    @wp.func
    def prepare(samples: samples_struct, p: int, scratch: scratch_struct):
        pass

    @wp.func
    def fill(samples: samples_struct, table: wp.array3d(dtype=float), form: wp.vec4, nx: lane_type, ny: lane_type, nz: lane_type, p: int,
             scratch: scratch_struct):
        vx, vy, vz = vector_at(samples.view, p)
        places = pairs()
        for k in range(lanes):
            n = wp.vec3(nx[k], ny[k], nz[k])
            plain = grid_position(n)
            turned = grid_position(reflecting_normal(n, wp.vec3(vx[k], vy[k], vz[k])))
            places[0, k] = plain[0]
            places[1, k] = plain[1]
            places[2, k] = turned[0]
            places[3, k] = turned[1]
        for light in range(samples.light_count):
            at = p * scratch.pack_stride + light * scratch.light_stride
            lobe = lane_type()
            for k in range(lanes):
                lobe[k] = look_up(table, wp.vec2(places[0, k], places[1, k]), light, 0)
            scratch.values[at] = lobe
            for a in range(1, count):
                for k in range(lanes):
                    lobe[k] = look_up(table, wp.vec2(places[2, k], places[3, k]), light, a)
                scratch.values[at + a * scratch.step] = lobe

    return Lobes(count, count, RELAXATION, prepare, fill)


@once
def tabulated_reflectance(lanes: int) -> Reflectance:
    """Return Relit's BRDF from a response table; a roughness of 0 stands for a surface without a specular lobe."""
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    pairs = wp.types.matrix(shape=(2, lanes), dtype=wp.float32)

    @wp.func
    def prepare(samples: samples_struct, table: wp.array3d(dtype=float), form: wp.vec4, nx: lane_type, ny: lane_type, nz: lane_type,
                p: int, scratch: scratch_struct):
        places = pairs()
        for k in range(lanes):
            place = grid_position(wp.vec3(nx[k], ny[k], nz[k]))
            places[0, k] = place[0]
            places[1, k] = place[1]
        for light in range(samples.light_count):
            fd = lane_type()
            for k in range(lanes):
                fd[k] = look_up(table, wp.vec2(places[0, k], places[1, k]), light, 0)
            scratch.values[p * scratch.pack_stride + light * scratch.light_stride] = fd

    @wp.func
    def respond(samples: samples_struct, table: wp.array3d(dtype=float), nx: lane_type, ny: lane_type, nz: lane_type, rough: lane_type,
                p: int, scratch: scratch_struct):
        vx, vy, vz = vector_at(samples.view, p)
        places = pairs()
        width = lane_type()
        for k in range(lanes):
            place = grid_position(reflecting_normal(wp.vec3(nx[k], ny[k], nz[k]), wp.vec3(vx[k], vy[k], vz[k])))
            places[0, k] = place[0]
            places[1, k] = place[1]
            width[k] = width_position(rough[k])
        for light in range(samples.light_count):
            fs, fixed = lane_type(), lane_type()
            for k in range(lanes):
                place = wp.vec2(places[0, k], places[1, k])
                narrow = wp.min(int(width[k]), wp.static(WIDTH_COUNT - 1))
                part = width[k] - float(narrow)
                column = 1 + 2 * narrow
                shines = wp.where(rough[k] > 0.0, 1.0, 0.0)
                fs[k] = shines * ((1.0 - part) * look_up(table, place, light, column)
                                  + part * look_up(table, place, light, column + 2))
                fixed[k] = shines * ((1.0 - part) * look_up(table, place, light, column + 1)
                                     + part * look_up(table, place, light, column + 3))
            at = p * scratch.pack_stride + light * scratch.light_stride
            scratch.values[at + scratch.step] = fs
            scratch.values[at + 2 * scratch.step] = fixed

    @wp.func
    def lambertian(samples: samples_struct, form: wp.vec4, nx: lane_type, ny: lane_type, nz: lane_type, p: int):
        one = lane_type()
        for k in range(lanes):
            one[k] = 1.0
        return one

    return Reflectance(3, prepare, respond, lambertian)
