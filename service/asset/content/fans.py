"""Vertices at which several fans of faces meet, split into one vertex for each fan: what modelling programs call manifold."""

import numpy as np

from service.asset.content.links import joined

APART_PX = 0.01
"""Distance in pixels by which the vertices of two fans are drawn apart: enough for single precision in images of 8192 pixels, unseen."""


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
