"""The three captured lights around a direction. The visibility of light between captured lights is interpolated from them, and a captured
image that is left out is predicted from them."""

import itertools

import numpy as np

from kernels.relight.latlong import first_of_equals
from kernels.relight.triangulation import find_faces, triangulate_sphere


def lights_around(directions: np.ndarray, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the three lights whose triangle each sample lies in.

    Args:
        directions: [lights, 3] unit vectors, four or more not in one plane.
        samples: [n, 3] unit vectors.

    Returns:
        [n, 3] int32 lights and [n, 3] float32 shares that sum to one; where lights are missing the nearest stand for the corners.

    Raises:
        ArrayError: fewer than four lights, or all in one plane.
    """
    kept = first_of_equals(directions)
    triangles = triangulate_sphere(directions[kept])
    nearest = kept[np.argmax(triangles.vertex @ directions[kept].T, axis=1)]
    nearest[: len(kept)] = kept
    face, share = find_faces(triangles, samples)
    return nearest[triangles.corner[face]].astype(np.int32), share.astype(np.float32)


def left_out(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lights that each light would be predicted from if it were missing, and their shares.

    Args:
        directions: [lights, 3] unit vectors, four or more not in one plane.

    Returns:
        [lights, 3] int32 and [lights, 3] float32. Taken from the neighbours of the light: of the triangles between them that hold it,
        the one whose farthest corner is nearest. Where none holds it, at the rim of a dome, all shares are 0.

    Raises:
        ArrayError: fewer than four lights, or all in one plane.
    """
    kept = first_of_equals(directions)
    triangles = triangulate_sphere(directions[kept])
    real = len(kept)
    around: list[set[int]] = [set() for _ in range(len(triangles.vertex))]
    for corners in triangles.corner:
        for a, b in itertools.permutations(corners.tolist(), 2):
            around[a].add(b)
    lights = np.zeros((len(directions), 3), np.int32)
    shares = np.zeros((len(directions), 3), np.float32)
    for vertex in range(real):
        ring = {other for other in around[vertex] if other < real}
        for imaginary in (other for other in around[vertex] if other >= real):  # replace an imaginary vertex by its real neighbours
            ring |= {other for other in around[imaginary] if other < real and other != vertex}
        triples = np.array(list(itertools.combinations(sorted(ring), 3)), dtype=int).reshape(-1, 3)
        corners = triangles.vertex[triples]
        inverse = np.linalg.pinv(np.swapaxes(corners, 1, 2))
        share = np.einsum("tij,j->ti", inverse, triangles.vertex[vertex])
        farthest = (corners @ triangles.vertex[vertex]).min(axis=1)
        holds = (share.min(axis=1) >= -1e-6) & (np.abs(np.linalg.det(corners)) > 1e-6)
        if holds.any():
            best = int(np.argmax(np.where(holds, farthest, -2)))
            lights[kept[vertex]] = kept[triples[best]]
            shares[kept[vertex]] = np.maximum(share[best], 0) / np.maximum(share[best], 0).sum()
    return lights, shares
