"""The deviation of each point of a placed scan from its design with its σ, and the means over patches, which verdicts follow from."""

from typing import NamedTuple

import numpy as np

from service.comparison.placing import ALIKE, Placement, gradient
from service.comparison.surfaces import Design, Offsets, ScannedSurface
from service.scans.points.rigid import applied

BATCH = 1 << 18
"""Points that are looked at together, which bounds the memory."""
LEAST_POINTS = 4
"""The fewest points of a patch that is judged."""
NEARBY = 0.25
"""The part of the design's size within which points that do not lie on it are taken for something that stands on it."""


class Deviations(NamedTuple):
    """The deviations of the points that belong to the design; n points of the scan, m of these."""

    placed: np.ndarray  # [n, 3] float32 metres, frame of the design
    normals: np.ndarray  # [n, 3] float32
    near: np.ndarray  # [m] int64: the points that belong to the design
    distance: np.ndarray  # [m] float64 metres, positive outside
    at: np.ndarray  # [m, 3] metres: their nearest points of the design
    face: np.ndarray  # [m] int32
    moves: np.ndarray  # [m, 6] float32: what a small motion of the scan adds to the distance
    noise: np.ndarray  # [m] metres: σ of the point itself


class Patches(NamedTuple):
    """Means of deviations over patches of the surface."""

    middle: np.ndarray  # [p, 3] metres, frame of the design
    normal: np.ndarray  # [p, 3] of the design there, unit
    deviation: np.ndarray  # [p] metres
    sigma: np.ndarray  # [p] metres
    points: np.ndarray  # [p] number of points


def deviations_of(design: Design, scan: ScannedSurface, placement: Placement, reach_m: float) -> Deviations:
    """Return how far the points of a placed scan lie from the design, those that are nearer than a reach and face as it does."""
    pose = placement.pose
    placed, normals = applied(pose, scan.points), scan.normals @ pose[:3, :3].T
    parts: list[Offsets] = []
    for first in range(0, len(placed), BATCH):
        found = design.offsets(placed[first:first + BATCH], reach_m)
        alike = np.einsum("ni,ni->n", normals[first + found.near], design.normals[found.face]) > ALIKE
        parts.append(Offsets(found.near[alike] + first, *(each[alike] for each in found[1:])))
    near, distance, across, at, face = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Deviations(placed.astype(np.float32), normals.astype(np.float32), near, distance, at, face,
                      gradient(at, across, placement.pivot).astype(np.float32), scan.sigma[near])


def standing_on(design: Design, found: Deviations, patches: Patches, *, patch_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places of the design [k, 3], metres, and its normals there [k, 3], above or below which enough points for a patch lie that do
    not belong to it: something else stands there, or the part is not what was designed."""
    others = np.delete(found.placed, found.near, axis=0).astype(np.float64)
    there = design.offsets(others, NEARBY * design.size)
    _, first, count = np.unique(np.floor(there.at / patch_m).astype(np.int64), axis=0, return_index=True, return_counts=True)
    usual = float(np.median(patches.points)) / 2 if len(patches.points) else 0.0
    many = first[count >= max(usual, LEAST_POINTS)]
    return there.at[many], design.normals[there.face[many]]


def sigma_of(found: Deviations, placement: Placement, shared_m: float) -> np.ndarray:
    """Return σ of each deviation [m], metres: of the point, of the pose, and of errors that all points share."""
    pose = np.einsum("mi,ij,mj->m", found.moves, placement.covariance, found.moves)
    return np.asarray(np.sqrt(found.noise**2 + pose + shared_m**2))


def patches_of(found: Deviations, design: Design, placement: Placement, *, patch_m: float, shared_m: float) -> Patches:
    """Return the means over patches: the points of a cell of a side in metres that face about the same way."""
    normal = design.normals[found.face]
    cell = np.floor((found.at - found.at.min(axis=0)) / patch_m).astype(np.int64)
    largest = np.abs(normal).argmax(axis=1)
    facing = 2 * largest + (normal[np.arange(len(normal)), largest] > 0)
    size = cell.max(axis=0) + 1
    _, of_point, count = np.unique((cell @ np.array([1, size[0], size[0] * size[1]])) * 6 + facing, return_inverse=True, return_counts=True)
    kept = count >= LEAST_POINTS

    def mean(values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(of_point, column, minlength=len(count)) / count for column in np.atleast_2d(values.T)]
        return np.stack(columns, axis=1)[kept]

    moves = mean(found.moves.astype(np.float64))
    noise = mean(found.noise**2)[:, 0] / count[kept]
    pose = np.einsum("pi,ij,pj->p", moves, placement.covariance, moves)
    across = mean(normal)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    return Patches(mean(found.at), across, mean(found.distance)[:, 0], np.sqrt(noise + pose + shared_m**2), count[kept])
