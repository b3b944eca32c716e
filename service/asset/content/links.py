"""Find the neighbouring pixels of a height map that lie on one surface: the mesh has faces between these, and between no others.

A camera sees nothing of what lies behind an edge that hides something, and so nothing of how the surface goes on there. Such a break is
known by the layer `part`, or by a step of the height that is much steeper than the normals of both pixels say. The comparison is made in
relief: height in pixels, towards the viewer, which for a perspective camera is −f · ln(depth), so that it does not depend on the distance.

Vertices at which several fans of faces meet are split into one for each fan: the mesh is then what modelling programs call manifold.
"""

from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera
from stage.results.depth_breaks import same_surface
from stage.results.maps import SurfaceMaps

STEEPER = 1.5
"""A step of the height breaks the surface from this multiple of the steeper slope that the two normals say: between two pixels of a
curved limb the mean slope is no greater than the steeper one, and normals near the limb are wrong by some degrees."""
STEP_PX = 1.5
"""Relief in pixels that a step may have beyond that: the height rests on all normals around, and differs so much where they are noisy."""
LEAST_FACING = 1e-2
"""Least cosine between a normal and the line of sight: steeper slopes than its hundred pixels a pixel support any step."""
ISLAND_PIXELS = 8
"""Patches of fewer linked pixels are left out: two pixels more than what noise on the rim of a mask makes."""

_ALL, _FIRST, _LAST = slice(None), slice(None, -1), slice(1, None)
NEIGHBOURS = ((_ALL, _FIRST), (_ALL, _LAST)), ((_FIRST, _ALL), (_LAST, _ALL))
"""Pixels and those to their right; pixels and those below them."""
APART_PX = 0.01
"""Distance in pixels by which the vertices of two fans are drawn apart: enough for single precision in images of 8192 pixels, unseen."""


class Links(NamedTuple):
    """True where two neighbouring pixels both have a height and lie on one surface."""

    right: np.ndarray  # [rows, cols - 1] bool, between a pixel and the one to its right
    down: np.ndarray  # [rows - 1, cols] bool, between a pixel and the one below it


def relief(height: np.ndarray, camera: Camera) -> np.ndarray:
    """Return heights, camera-frame z, negative in front of a perspective camera, in pixels that grow towards the viewer."""
    if camera.focal_px is None:
        return height / (camera.pixel_size_m or 1.0)
    return -float(np.mean(camera.focal_px)) * np.log(-height)


def height_of(relief_px: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the camera-frame z of a relief in pixels: the inverse of `relief`."""
    if camera.focal_px is None:
        return relief_px * (camera.pixel_size_m or 1.0)
    return -np.exp(-relief_px / float(np.mean(camera.focal_px)))


def surface_links(maps: SurfaceMaps, valid: np.ndarray) -> Links:
    """Return which neighbouring pixels lie on one surface; without normals a step is a break where it is steeper than 80 degrees."""
    assert maps.height is not None
    height = np.where(valid, maps.height, -1).astype(np.float32)
    links = []
    for axis in range(2):
        here, there = NEIGHBOURS[axis]
        linked = valid[here] & valid[there]
        if maps.part is not None:
            linked &= maps.part[here] == maps.part[there]
        if maps.normal is None:
            linked &= same_surface(-height[here], -height[there], 1.0, maps.camera)
        else:
            slope = slopes(maps.normal, maps.camera)[axis]
            step = np.diff(relief(height, maps.camera), axis=1 - axis)
            support = np.maximum(np.sign(step) * slope[here], np.sign(step) * slope[there])
            linked &= np.abs(step) <= STEEPER * np.maximum(support, 0) + STEP_PX
        links.append(linked)
    return Links(*links)


def slopes(normal: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return how relief grows from a pixel to the one on its right and to the one below, as its normal says, in pixels a pixel.
    `normal`: [rows, cols, 3] unit, camera frame; slopes are 0 where it is 0 or not finite."""
    across, up, facing = (np.nan_to_num(normal[..., axis], posinf=0, neginf=0) for axis in range(3))
    if camera.focal_px is not None:
        x, y = (plane.astype(np.float32) for plane in camera.plane_coordinates())
        facing = facing - across * x - up * y
    facing = np.maximum(facing, LEAST_FACING)
    return -across / facing, up / facing


def without_islands(links: Links) -> Links:
    """Return the links without those of small patches of pixels that are linked to no others; the largest patch stays in any case."""
    patch, sizes = _patches(links)
    kept = (sizes >= min(ISLAND_PIXELS, int(sizes.max(initial=0))))[patch]
    return Links(links.right & kept[:, 1:], links.down & kept[1:])


def touched(links: Links) -> np.ndarray:
    """Return the pixels that are linked to any other: [rows, cols] bool."""
    pixels = np.zeros((len(links.right), links.down.shape[1]), dtype=bool)
    pixels[:, 1:] |= links.right
    pixels[:, :-1] |= links.right
    pixels[1:] |= links.down
    pixels[:-1] |= links.down
    return pixels


def _patches(links: Links) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the patch of every pixel, [rows, cols] int32, and the pixels of each patch.

    Pixels without a link have the number of any patch. Runs of linked pixels of a row are numbered first.
    """
    pixels = touched(links)
    if not pixels.any():
        return np.zeros(pixels.shape, dtype=np.int32), np.zeros(1, dtype=np.int64)
    starts = pixels.copy()
    starts[:, 1:] &= ~links.right
    run = np.maximum(np.cumsum(starts, dtype=np.int32) - np.int32(1), 0).reshape(pixels.shape)
    above, below = run[:-1][links.down], run[1:][links.down]
    new = np.ones(len(above), dtype=bool)
    new[1:] = (above[1:] != above[:-1]) | (below[1:] != below[:-1])
    patch = joined(int(run.max()) + 1, above[new], below[new])[run]
    return patch, np.bincount(patch[pixels], minlength=int(patch.max()) + 1)


def joined(count: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the least member of the set of each of `count` items, [count] int32, where first[i] and second[i] are of one set."""
    from scipy.sparse import coo_array  # loaded here, since that takes a tenth of a second
    from scipy.sparse.csgraph import connected_components

    _, label = connected_components(coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(count, count)), directed=False)
    return np.unique(label, return_index=True)[1][label].astype(np.int32)


def split_fans(quads: np.ndarray, triangles: np.ndarray, vertex_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return faces of which those around each vertex form one fan.
    `quads`: [Q, 4] int32. triangles: [T, 3] int32. They lie side by side in an image: no edge has more than two faces, and no other face
    touches a vertex that a closed fan surrounds. Returns the faces with new vertex numbers, and the old number of every vertex, [V'] int64;
    the old vertices come first."""
    corner_vertex = np.concatenate([quads.ravel(), triangles.ravel()])
    following = np.concatenate([np.roll(quads, -1, axis=1).ravel(), np.roll(triangles, -1, axis=1).ravel()])
    low, high = np.minimum(corner_vertex, following).astype(np.int64), np.maximum(corner_vertex, following)
    edge = low * vertex_count + high
    order = np.argsort(edge, kind="stable")
    same = edge[order[1:]] == edge[order[:-1]]

    faces = np.bincount(corner_vertex, minlength=vertex_count)
    first = np.ones(len(order), dtype=bool)
    first[1:] = ~same
    edges = np.bincount(low[order[first]], minlength=vertex_count) + np.bincount(high[order[first]], minlength=vertex_count)
    shared = edges - faces > 1  # a closed fan has as many edges as faces, an open one has one more
    source = np.arange(vertex_count)
    if not shared.any():
        return quads, triangles, source

    # the corners of two faces at both ends of their common edge belong to the same fans
    next_corner = np.concatenate([np.roll(np.arange(quads.size).reshape(quads.shape), -1, axis=1).ravel(),
                                  quads.size + np.roll(np.arange(triangles.size).reshape(triangles.shape), -1, axis=1).ravel()])
    one, two = order[:-1][same], order[1:][same]
    opposite = corner_vertex[one] != corner_vertex[two]
    fan = joined(len(corner_vertex), np.concatenate([one, next_corner[one]]),
                 np.concatenate([np.where(opposite, next_corner[two], two), np.where(opposite, two, next_corner[two])]))

    at_shared = np.flatnonzero(shared[corner_vertex])
    fans, fan_of_corner = np.unique(fan[at_shared], return_inverse=True)
    owner = corner_vertex[fans]
    kept = np.zeros(len(fans), dtype=bool)
    kept[np.unique(owner, return_index=True)[1]] = True
    number = np.where(kept, owner, vertex_count + np.cumsum(~kept) - 1)
    renumbered = corner_vertex.copy()
    renumbered[at_shared] = number[fan_of_corner]
    return (renumbered[:quads.size].reshape(quads.shape), renumbered[quads.size:].reshape(triangles.shape),
            np.concatenate([source, owner[~kept]]))


def drawn_apart(places: np.ndarray, quads: np.ndarray, triangles: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Return the places of vertices, the first two coordinates in pixels, with those that split_fans made of one drawn into their own
    fans, so that no two are at one place."""
    split = np.bincount(source, minlength=len(source))[source] > 1
    if not split.any():
        return places
    towards, count = np.zeros_like(places), np.zeros(len(places))
    for faces in (quads, triangles):
        touching = faces[split[faces].any(axis=1)]
        centre = places[touching].mean(axis=1)
        for vertex in touching.T:
            np.add.at(towards, vertex, centre - places[vertex])
            np.add.at(count, vertex, 1)
    towards /= np.maximum(count, 1)[:, None]
    length = np.linalg.norm(towards[:, :2], axis=1)
    return np.where(split[:, None], places + towards * (APART_PX / np.maximum(length, APART_PX))[:, None], places)
