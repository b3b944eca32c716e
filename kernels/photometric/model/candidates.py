"""Candidate normals: rings about a normal, on the host and in kernels."""

import math
from typing import Any

import numpy as np
import warp as wp

from kernels.device import once
from kernels.packs import pack_type

LEAST_NZ = 0.02
"""Least cosine between a candidate and the viewer: a visible surface faces the viewer."""


def rings(degrees: tuple[float, ...], last_count: int) -> np.ndarray:
    """Return the offsets of candidates from a centre: the centre, then rings.

    They are [candidates, 4] float32: sine and cosine of the angle from the centre, cosine and sine of the azimuth.
    """
    offsets = [(0.0, 1.0, 1.0, 0.0)]
    for index, angle in enumerate(degrees):
        count = max(6, int(last_count * min(1.0, 1.2 * angle / degrees[-1])))
        for step in range(count):
            azimuth = 2 * math.pi * step / count + 0.5 * index  # rings do not line up
            offsets.append((math.sin(math.radians(angle)), math.cos(math.radians(angle)), math.cos(azimuth), math.sin(azimuth)))
    return np.array(offsets, dtype=np.float32)


@wp.func
def tangents(n: wp.vec3):
    """Return two unit vectors that are perpendicular to a unit normal and to each other."""
    up = wp.where(wp.abs(n[2]) < 0.9, wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0))
    tangent = wp.normalize(wp.cross(up, n))
    return tangent, wp.cross(n, tangent)


@wp.func
def candidate_at(n: wp.vec3, offset: wp.vec4, v: wp.vec3):
    """Return the unit normal at an offset of `rings` from n, moved along the view v where it would look away from the viewer."""
    tangent, other = tangents(n)
    moved = offset[1] * n + offset[0] * (offset[2] * tangent + offset[3] * other)
    moved += wp.max(LEAST_NZ - wp.dot(moved, v), 0.0) * v
    return moved * (1.0 / wp.sqrt(wp.dot(moved, moved)))


@once
def candidate_packs(lanes: int) -> Any:
    """Return the Warp function that is `candidate_at` for packs: components of the normals and views in, those of the candidates out."""
    lane_type = pack_type(lanes, wp.float32)

    @wp.func
    def candidates_at(nx: lane_type, ny: lane_type, nz: lane_type, offset: wp.vec4, vx: lane_type, vy: lane_type, vz: lane_type):
        x, y, z = lane_type(), lane_type(), lane_type()
        for k in range(lanes):
            moved = candidate_at(wp.vec3(nx[k], ny[k], nz[k]), offset, wp.vec3(vx[k], vy[k], vz[k]))
            x[k] = moved[0]
            y[k] = moved[1]
            z[k] = moved[2]
        return x, y, z

    return candidates_at
