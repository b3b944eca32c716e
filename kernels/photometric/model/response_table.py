"""Readings of each lobe under lights of any extent, tabulated over the normals of the visible hemisphere.

A light is samples of its radiance, each a small disc of its solid angle, here as shares of the light's irradiance: their sum is
one, and a light of one sample is a distant one. At a node of the table, normal n under view z, a column holds for every light
  0         Σ share · n·l / π                        Lambert's lobe of albedo one
  1, 2      the mirror's A and B
  3, 4 …    A and B of GGX lobes of widths WIDTHS
where a lobe with Schlick's Fresnel reads F0 A + B. A disc widens a GGX lobe by its own second moment among half vectors; the
mirror sees the radiance around the reflected direction, each sample spread just so far that samples on an even lattice join
without ripples.

Nodes are even in the square of the hemisphere's octahedral map: u = (x + y) / s, v = (x - y) / s, s = |x| + |y| + z, both -1…1.

Source: Nayar, Ikeuchi and Kanade, "Determining shape and reflectance of hybrid surfaces by photometric sampling", IEEE
Transactions on Robotics and Automation 1990, (extended sources, and the reflectance integrated
over them); Cigolle et al., "A survey of efficient representations for independent unit vectors", JCGT 2014 (the map).
"""

import math
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once, to_numpy
from kernels.errors import ArrayError
from kernels.microfacet import INVERSE_PI, ggx, schlick
from kernels.packs import pack_type, vector_at

GRID = 96
"""Nodes along a side of the table: 0.9° apart at the pole and at most 1.7°, so that a lamp 15° across is tabulated to 0.3 % of its peak."""
WIDTH_COUNT = 10
"""Number of GGX widths in the table."""
NARROWEST, WIDTH_RATIO = 1 / 15, 15.0 ** (1 / (WIDTH_COUNT - 1))
"""Narrowest GGX width α of the table and the ratio of each width to the one before, from 0.067 to 1: a narrower lobe falls between the
samples of a source at grazing angles."""
WIDTHS = tuple(NARROWEST * WIDTH_RATIO**j for j in range(WIDTH_COUNT))
"""GGX widths α of the table, ascending."""
MIRROR_ALPHA = 0.01
"""Width α that the mirror stands for: roughness 0.1, below which an extended light no longer resolves the lobe."""
SEARCH_WIDTHS = (2, 4, 6)
"""Indices in WIDTHS of the lobes that the mixture of the search has besides the mirror, α = 0.12, 0.22 and 0.41. Over a wide light a
narrower lobe is a sum of the mirror's and the next, and a wider one of the last and the diffuse one."""
POSTERIOR_WIDTHS = (0, 2, 4, 6)
"""Indices in WIDTHS of the lobes by which the posterior is judged, α = 0.067 beside those of the search: under sources 16° across, the
mixture of the search misses the readings of a metal of α = 0.09 by a third, and would then take any normal for as good."""
SPECULAR_SCALE = 0.1
"""Scale of the specular lobes of the search relative to the diffuse one, so that their weights are of one order of magnitude."""
COLUMNS = 3 + 2 * WIDTH_COUNT
"""Number of columns: one for Lambert's lobe, and A and B of the mirror and of each width."""
SEARCH_LOBES = 2 + len(POSTERIOR_WIDTHS)
"""Largest number of lobes of a mixture: diffuse, mirror and the GGX lobes."""
LEAST_NZ = 0.02
"""Least cosine between a node's normal and the viewer; the nodes at the rim are raised to it."""
JOIN = 0.36
"""Variance of a mirrored sample over its solid angle: Gaussians 0.6 of a lattice step wide add up to a constant within 0.2 %."""
MIRROR_SPREAD = 0.026
"""Least spread of a mirrored sample, radians: half a step of the table seen in the mirror."""


def response_table(direction: np.ndarray, solid_angle: np.ndarray, light: np.ndarray, share: np.ndarray, *,
                   light_count: int, device: str) -> wp.array:
    """Tabulate the readings of every lobe under every light; waits for the device.

    Args:
        direction: [samples, 3] unit, from the surface to the sample.
        solid_angle: [samples] steradians; 0 for a distant light.
        light: [samples] which light the sample belongs to.
        share: [samples] of the light's irradiance, radiance · solid angle / their sum.

    Returns:
        [GRID², light_count, COLUMNS] float32 on the device, node u · GRID + v.
    """
    count = len(direction)
    if direction.shape != (count, 3) or any(array.shape != (count,) for array in (solid_angle, light, share)) or count == 0:
        raise ArrayError(f"direction is {direction.shape}, solid_angle {solid_angle.shape}, light {light.shape}, "
                         f"share {share.shape}: give one row of each per sample")
    # samples that lights share are evaluated once
    rows = np.concatenate([direction, solid_angle[:, None]], axis=1).astype(np.float32)
    places, inverse = np.unique(rows, axis=0, return_inverse=True)
    order = np.argsort(inverse.reshape(-1), kind="stable")
    first = np.searchsorted(inverse.reshape(-1)[order], np.arange(len(places) + 1))
    lanes = devices.pack_width(device) if device == "cpu" else 1
    lane_type = pack_type(lanes, wp.float32)
    normals = nodes()
    packs = len(normals) // lanes
    planes = wp.array(np.ascontiguousarray(normals.T.astype(np.float32)).reshape(3, packs, lanes), dtype=lane_type, device=device)
    table = wp.zeros(packs * light_count * COLUMNS, dtype=lane_type, device=device)
    devices.launch(_table_kernel(lanes), packs,
                   [planes, wp.array(places, dtype=wp.vec4, device=device), wp.array(first, dtype=wp.int32, device=device),
                    wp.array(light[order], dtype=wp.int32, device=device),
                    wp.array(share[order], dtype=wp.float32, device=device), light_count], [table], device=device)
    flat = to_numpy(table).reshape(packs, light_count, COLUMNS, lanes).transpose(0, 3, 1, 2)
    return wp.array(flat.reshape(GRID * GRID, light_count, COLUMNS), dtype=wp.float32, device=device)


def search_table(table: wp.array, f0: float, widths: tuple[int, ...] = SEARCH_WIDTHS) -> wp.array:
    """Return the lobes of the search, specular ones of reflectance f0 at normal incidence; waits for the device.
    `table`: of response_table. `widths`: indices in WIDTHS of the GGX lobes. Returns [GRID², lights, 2 + widths] float32: π times the
    diffuse column, and SPECULAR_SCALE / f0 times the mirror and the GGX lobes."""
    values = to_numpy(table)
    kept = np.array([0, *(1 + j for j in widths)])
    specular = SPECULAR_SCALE / f0 * (f0 * values[..., 1 + 2 * kept] + values[..., 2 + 2 * kept])
    return wp.array(np.concatenate([math.pi * values[..., :1], specular], axis=-1), dtype=wp.float32, device=table.device)


def nodes() -> np.ndarray:
    """Return the [GRID², 3] float64 normals of the table, those at the rim raised to LEAST_NZ."""
    u, v = np.meshgrid(*[np.linspace(-1, 1, GRID)] * 2, indexing="ij")
    x, y = (u + v) / 2, (u - v) / 2
    normals = np.stack([x, y, np.maximum(1 - np.abs(x) - np.abs(y), 0)], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:, 2] = np.maximum(normals[:, 2], LEAST_NZ)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@wp.func
def grid_position(n: wp.vec3) -> wp.vec2:
    """Return where a normal of the visible hemisphere lies among the nodes, 0…GRID - 1 each way."""
    scale = wp.static(0.5 * (GRID - 1)) / (wp.abs(n[0]) + wp.abs(n[1]) + wp.max(n[2], 0.0))
    middle = wp.static(0.5 * (GRID - 1))
    return wp.vec2(middle + (n[0] + n[1]) * scale, middle + (n[0] - n[1]) * scale)


@once
def _table_kernel(lanes: int) -> Any:
    lane_type = pack_type(lanes, wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def table_kernel(first: int,
                     normal: wp.array2d(dtype=lane_type),  # [3, P]
                     places: wp.array(dtype=wp.vec4),  # [places] direction, solid angle
                     begins: wp.array(dtype=wp.int32),  # [places + 1] first sample of each place
                     light: wp.array(dtype=wp.int32),  # [samples]
                     share: wp.array(dtype=wp.float32),  # [samples]
                     light_count: int,
                     # outputs
                     table: wp.array(dtype=lane_type)):  # [P · L · COLUMNS]
        p = first + wp.tid()
        base = p * light_count * COLUMNS
        nx, ny, nz = vector_at(normal, p)
        for place in range(places.shape[0]):
            lx, ly, lz, solid = places[place][0], places[place][1], places[place][2], places[place][3]
            begin, end = begins[place], begins[place + 1]
            nl, nh, mirror, bare, risen = lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
            lit, seen = float(0.0), float(0.0)  # variables of a Warp loop
            inverse = 1.0 / wp.sqrt(wp.max(2.0 + 2.0 * lz, 1.0e-6))
            vh = wp.sqrt(wp.max(0.5 + 0.5 * lz, 1.0e-4))
            rise = schlick(vh)
            spread = JOIN * solid + wp.static(MIRROR_SPREAD**2)
            for k in range(lanes):
                cosine = nx[k] * lx + ny[k] * ly + nz[k] * lz
                nl[k] = wp.max(cosine, 0.0)
                nh[k] = (cosine + nz[k]) * inverse
                lit = wp.max(lit, nl[k])
                # to the reflected direction, 2 (n·v) n - v
                around = (2.0 * nz[k] * cosine - lz - 1.0) / spread
                mirror[k] = wp.exp(around) * wp.static(0.5 / math.pi) / (spread * (1.0 - wp.exp(-2.0 / spread)))
                seen = wp.max(seen, mirror[k])
            if lit > 0.0:
                for k in range(lanes):
                    bare[k] = INVERSE_PI * nl[k]
                for e in range(begin, end):
                    at = base + light[e] * COLUMNS
                    table[at] = table[at] + share[e] * bare
                for j in range(WIDTH_COUNT):
                    alpha = NARROWEST * wp.pow(wp.static(float(WIDTH_RATIO)), float(j))
                    wide = wp.min(wp.sqrt(alpha * alpha + wp.static(0.125 / math.pi) * solid / vh), 1.0)
                    for k in range(lanes):
                        lobe = ggx(nl[k], nz[k], nh[k], wide)
                        bare[k] = (1.0 - rise) * lobe
                        risen[k] = rise * lobe
                    for e in range(begin, end):
                        at = base + light[e] * COLUMNS + 3 + 2 * j
                        table[at] = table[at] + share[e] * bare
                        table[at + 1] = table[at + 1] + share[e] * risen
            if seen > 1.0e-6:
                for k in range(lanes):
                    fresnel = schlick(nz[k])
                    bare[k] = (1.0 - fresnel) * mirror[k]
                    risen[k] = fresnel * mirror[k]
                for e in range(begin, end):
                    at = base + light[e] * COLUMNS + 1
                    table[at] = table[at] + share[e] * bare
                    table[at + 1] = table[at + 1] + share[e] * risen

    return table_kernel
