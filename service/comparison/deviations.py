"""The deviation of each point of a placed scan from its design with its σ, and the means over patches, which verdicts follow from."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from service.comparison.placing import ALIKE, Placement, gradient
from service.comparison.surfaces import Design, Offsets, ScannedSurface
from service.scans.points.rigid import applied
from stage.errors import ScanError

BATCH = 1 << 18
"""Points that are looked at together, which bounds the memory."""
LEAST_POINTS = 4
"""The fewest points of a patch that is judged."""
BY_CHANCE = 1e-5
"""Probability of a scatter in a patch from which σ of the points does not explain it, and the scatter itself counts."""
NEARBY = 0.25
"""The part of the design's size within which points that do not lie on it are taken for something that stands on it."""
SAMPLES, BESIDE = 40_000, 0.1
"""Points of the design on which others may stand, and how far beside the surface these may lie along it, in sides of a patch."""


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
    """Return how far the points of a placed scan lie from the design, those that are nearer than a reach and face as it does; ScanError if
    there is none."""
    pose = placement.pose
    placed, normals = applied(pose, scan.points), scan.normals @ pose[:3, :3].T
    parts: list[Offsets] = []
    for first in range(0, len(placed), BATCH):
        found = design.offsets(placed[first:first + BATCH], reach_m)
        alike = np.einsum("ni,ni->n", normals[first + found.near], design.normals[found.face]) > ALIKE
        parts.append(Offsets(found.near[alike] + first, *(each[alike] for each in found[1:])))
    near, distance, across, at, face = (np.concatenate(each) for each in zip(*parts, strict=True))
    if not len(near):
        raise ScanError(f"the scan does not lie on the design: no point comes within {1e3 * reach_m:.3g} mm of it and faces the same way")
    return Deviations(placed.astype(np.float32), normals.astype(np.float32), near, distance, at, face,
                      gradient(at, across, placement.pivot).astype(np.float32), scan.sigma[near])


def standing_on(design: Design, found: Deviations, patches: Patches, *, patch_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places of the design [k, 3], metres, and its normals there [k, 3], above or below which enough points for a patch lie that do
    not belong to it: something else stands there, or the part is not what was designed. They stand on what is nearest, and on what is
    before or behind them and faces as they do: the floor of a deep pocket may be nearer to the other side of its wall."""
    others, normals = (np.delete(each, found.near, axis=0).astype(np.float64) for each in (found.placed, found.normals))
    reach = NEARBY * design.size
    there = [design.offsets(others, reach)]
    samples, face = design.sample(SAMPLES)
    tree = cKDTree(np.concatenate([samples, reach * design.normals[face]], axis=1))
    nearest = tree.query(np.concatenate([others, reach * normals], axis=1))[1]
    across = design.normals[face[nearest]]
    height = np.einsum("ni,ni->n", others - samples[nearest], across)
    alike = (np.abs(height) < reach) & (np.einsum("ni,ni->n", normals, across) > ALIKE)
    there.append(design.offsets((others - height[:, None] * across)[alike], BESIDE * patch_m))
    usual = float(np.median(patches.points)) / 2 if len(patches.points) else 0.0
    places: list[tuple[np.ndarray, np.ndarray]] = []
    for each in there:
        _, first, count = np.unique(np.floor(each.at / patch_m).astype(np.int64), axis=0, return_index=True, return_counts=True)
        many = first[count >= max(usual, LEAST_POINTS)]
        places.append((each.at[many], design.normals[each.face[many]]))
    at, facing = (np.concatenate(each) for each in zip(*places, strict=True))
    return at, facing


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
    deviation = mean(found.distance)[:, 0]
    scatter = np.maximum(mean(found.distance**2)[:, 0] - deviation**2, 0) * count[kept] / (count[kept] - 1)
    noise = mean(found.noise**2)[:, 0]
    unlike = scatter > noise * chdtri(count[kept] - 1, BY_CHANCE) / (count[kept] - 1)  # stray points, or a fault in a part of the patch
    noise = np.where(unlike, scatter, noise) / count[kept]
    pose = np.einsum("pi,ij,pj->p", moves, placement.covariance, moves)
    across = mean(normal)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    return Patches(mean(found.at), across, deviation, np.sqrt(noise + pose + shared_m**2), count[kept])
