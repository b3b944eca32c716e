"""Light that the patches of a surface send each other, gathered patch by patch from a tree: near patches one by one, far ones in groups.

A patch receives from another cos cos' A / (π r²) of its radiance, its form factor, unless something stands between. Most of the light in a
fold comes from patches a few pixels away, so that patches must be small, and there are as many pairs as the square of their number. Patches
whose normals are in the same quarter are therefore grouped into squares of two, four, … a side, and a group that is small beside its
distance sends as one patch.

Sources: Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991: on a Lambertian surface radiance = direct + ρ K radiance
with the form factors K, so that the direct light follows from the measured radiance without a series of bounces; groups after Barnes and
Hut, "A hierarchical O(N log N) force-calculation algorithm", Nature 1986.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.surface.shadows import Camera, Projection, between_pixels, project

OPENING = 0.25
"""Largest radius of a group over its distance at which it sends as one patch: the light in a right-angled groove is then within 3 %."""
SECTORS = 4
"""Parts of the azimuth into which normals are sorted before they are grouped: the two sides of a fold, of which one faces a patch and
the other looks away, would cancel in a group of both."""
LEAST_FACTOR = 1.0e-4
"""Least form factor of a pair that is tested for an obstacle between its patches: all smaller ones together change a reading by less than a
part in a thousand."""
SIGHT_STEPS = 8
"""Most points on the line between two patches at which the height is looked up, one for each pixel that it crosses."""
SIGHT_MARGIN_PIXELS = 1.0
"""Distance, in pixels, by which the surface must stand above the line between two patches to hide it: patches are coarse."""
VALUES = 16
"""Values of a patch that are added together, as wide as SIMD registers."""


class PatchTree(NamedTuple):
    """Patches and groups of them in depth-first order: a group comes before its members."""

    centre: np.ndarray  # [nodes, 3]
    facing: np.ndarray  # [nodes, 3] sum of area · normal
    area: np.ndarray  # [nodes] mean area of a patch
    radius: np.ndarray  # [nodes] of the sphere about the centre that holds the members
    following: np.ndarray  # [nodes] int, the first node that is no member
    patch: np.ndarray  # [nodes] int, the patch; -1 for a group
    radiance: np.ndarray  # [nodes, values] mean over the area


def group_patches(points: np.ndarray, normals: np.ndarray, areas: np.ndarray, cells: np.ndarray, radiance: np.ndarray) -> PatchTree:
    """Return the tree of patches that lie in the same square of their grid and face the same way, given as for gather_light."""
    sector = np.floor((np.arctan2(normals[:, 1], normals[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    key = sector << 30 | _interleave(cells[:, 0]) | _interleave(cells[:, 1]) << 1
    order = np.argsort(key, kind="stable")
    key, size = key[order], len(order)
    points, area, radiance = points[order], areas[order, None], radiance[order]
    facing, radius = normals[order] * area, np.sqrt(area) / 2
    begin = np.arange(size)
    begins, ends, levels = [begin], [begin + 1], [np.zeros(size, dtype=int)]
    nodes = [(points, facing, area, radius, radiance)]
    sums = (points * area, facing, area, radiance * area.astype(radiance.dtype))
    while len(begin) > len(np.unique(sector)):
        ended = np.r_[begin[1:], size]
        below, begin = begin, np.flatnonzero(np.r_[True, np.diff(key >> 2 * len(levels)) > 0])
        end = np.r_[begin[1:], size]
        member = np.searchsorted(below, begin)  # the first member of each group on the level below, whose sums add up to the group's
        sums = tuple(np.add.reduceat(values, member) for values in sums)
        moment, turned, total, power = sums
        centre = moment / total
        reach = np.linalg.norm(points - np.repeat(centre, end - begin, axis=0), axis=1, keepdims=True) + radius
        grown = end != ended[member]  # it has members beside its first one on the level below
        groups = (centre, turned, total / (end - begin)[:, None], np.maximum.reduceat(reach, begin))
        nodes.append((*(values[grown] for values in groups), power[grown] / total[grown].astype(power.dtype)))
        begins.append(begin[grown])
        ends.append(end[grown])
        levels.append(np.full(int(grown.sum()), len(levels)))
    first, last, level = (np.concatenate(each) for each in (begins, ends, levels))
    sequence = np.lexsort((-level, first))
    centre, facing, area, radius, sent = (np.concatenate(each)[sequence].astype(np.float32) for each in zip(*nodes, strict=True))
    following = np.searchsorted(first[sequence], last[sequence]).astype(np.int32)
    patch = np.where(level == 0, order[first], -1)[sequence].astype(np.int32)
    return PatchTree(centre, facing, area[:, 0], radius[:, 0], following, patch, sent)


def gather_light(
    points: np.ndarray,  # [n, 3] camera-frame centres
    normals: np.ndarray,  # [n, 3] unit
    areas: np.ndarray,  # [n] in the square of the points' unit
    cells: np.ndarray,  # [n, 2] int, row and column of each patch in a grid of patches, each below 32768
    radiance: np.ndarray,  # [n, values], for example of each channel under each light
    height: wp.array,  # [rows, cols] float32 camera-frame z
    mask: wp.array, projection: Projection, *, device: str,
    opening: float | None = None,  # of groups, in place of OPENING; 0: every patch sends on its own
    receivers: tuple[np.ndarray, np.ndarray] | None = None,  # points and normals, [m, 3] each, that receive the light in place of the n
) -> np.ndarray:
    """Return what each patch of albedo 1 sends on of the light of all others: Σⱼ K[i, j] radianceⱼ, [n or m, values]; waits for the device.

    K[i, j] = cosᵢ cosⱼ Aⱼ / (π r² + Aⱼ), or 0 where something stands between: the distance between neighbours is kept from vanishing by
    the size of the patch.
    """
    count = len(points)
    if points.shape != (count, 3) or normals.shape != (count, 3) or areas.shape != (count,) or count == 0:
        raise ArrayError(f"points are {points.shape}, normals {normals.shape}, areas {areas.shape}: give [n, 3], [n, 3] and [n]")
    if cells.shape != (count, 2) or len(radiance) != count:
        raise ArrayError(f"cells are {cells.shape}, radiance {radiance.shape}: give [n, 2] and [n, values] for {count} patches")
    opening = OPENING if opening is None else opening
    tree = group_patches(points, normals, areas, cells, radiance)
    patch = tree.patch
    if receivers is not None:
        points, normals = receivers
        patch = np.where(patch < 0, patch, patch + len(points)).astype(np.int32)  # none of those that send receives
        count = len(points)
    values = radiance.shape[1]
    packs = -(-values // VALUES)
    pack = pack_type(VALUES, wp.float32)
    sent = np.zeros((len(tree.patch), packs * VALUES), dtype=np.float32)
    sent[:, :values] = tree.radiance
    arriving = wp.zeros((count, packs), dtype=pack, device=device)

    def upload(array: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device)

    devices.launch(_gather_kernel, count,
                   [upload(points, wp.vec3), upload(normals, wp.vec3), upload(tree.centre, wp.vec3), upload(tree.facing, wp.vec3),
                    upload(tree.area, wp.float32), upload(tree.radius, wp.float32), upload(tree.following, wp.int32),
                    upload(patch, wp.int32), upload(sent.reshape(-1, packs, VALUES), pack), float(opening), height, mask,
                    projection.on_device()], [arriving], device=device, uneven=True)
    return to_numpy(arriving).reshape(count, -1)[:, :values]


def _interleave(number: np.ndarray) -> np.ndarray:
    """Return numbers below 32768 with a zero bit above each bit, so that two of them make the key of a place in a quadtree."""
    spread = number.astype(np.int64)
    for shift, kept in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        spread = (spread | spread << shift) & kept
    return spread


@wp.func
def _hidden(a: wp.vec3, b: wp.vec3, height: wp.array2d(dtype=float), mask: wp.array2d(dtype=wp.uint8), camera: Camera) -> bool:
    between = bool(False)  # a literal could not change inside the loop
    crossed = wp.length(project(b, camera) - project(a, camera))
    steps = wp.min(int(wp.floor(crossed)) - 1, SIGHT_STEPS)  # below 1 between neighbours
    for step in range(steps):
        point = a + (b - a) * (float(step + 1) / float(steps + 1))
        at = project(point, camera)
        u, v = at[0] - 0.5, at[1] - 0.5
        c, r = int(wp.floor(u)), int(wp.floor(v))
        if r >= 0 and c >= 0 and r < mask.shape[0] - 1 and c < mask.shape[1] - 1:
            margin = SIGHT_MARGIN_PIXELS * wp.where(camera.perspective, -point[2], 1.0) / (0.5 * (camera.scale[0] + camera.scale[1]))
            whole = mask[r, c] * mask[r, c + 1] * mask[r + 1, c] * mask[r + 1, c + 1]
            between = between or (whole != wp.uint8(0) and between_pixels(height, u, v) > point[2] + margin)
    return between


@wp.kernel(enable_backward=False, module="unique")
def _gather_kernel(first: int,
                   points: wp.array(dtype=wp.vec3),  # [n]
                   normals: wp.array(dtype=wp.vec3),  # [n]
                   centres: wp.array(dtype=wp.vec3),  # [nodes]
                   facing: wp.array(dtype=wp.vec3),  # [nodes] area · normal
                   areas: wp.array(dtype=float),  # [nodes] of a patch
                   radii: wp.array(dtype=float),  # [nodes]
                   following: wp.array(dtype=int),  # [nodes]
                   patches: wp.array(dtype=int),  # [nodes]
                   radiance: wp.array2d(dtype=pack_type(VALUES, wp.float32)),  # [nodes, packs]
                   opening: float,
                   height: wp.array2d(dtype=float),
                   mask: wp.array2d(dtype=wp.uint8),
                   camera: Camera,
                   # outputs
                   arriving: wp.array2d(dtype=pack_type(VALUES, wp.float32))):  # [n, packs]
    i = first + wp.tid()
    point, normal = points[i], normals[i]
    node = wp.int32(0)  # a literal could not change inside the loop
    while node < centres.shape[0]:
        way = centres[node] - point
        far = wp.length(way)
        if patches[node] < 0 and radii[node] >= opening * far:
            node = node + 1  # too near for its size: its members, one by one
        else:
            if patches[node] != i and far > 0.0:
                here = wp.max(wp.dot(normal, way) / far, 0.0)
                there = wp.max(-wp.dot(facing[node], way) / far, 0.0)
                value = here * there / (wp.pi * far * far + areas[node])
                if value > LEAST_FACTOR and _hidden(point, centres[node], height, mask, camera):
                    value = 0.0
                if value > 0.0:
                    for k in range(arriving.shape[1]):
                        arriving[i, k] = arriving[i, k] + value * radiance[node, k]
            node = following[node]
