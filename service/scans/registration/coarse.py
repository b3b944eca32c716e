"""Features of points, and rough poses of one scan against another from matched features, without any start.

Fast point feature histograms describe the surface around a point, whatever the pose. Source: Rusu, Blodow and Beetz, "Fast Point Feature
Histograms (FPFH) for 3D registration", ICRA 2009.

Matches that keep the distances between points and the angles between normals agree with each other; those that agree with the same further
matches are grown to a pose. Source: Chen, Sun, Yang and Tao, "SC2-PCR: a second order spatial compatibility for efficient and robust point
cloud registration", CVPR 2022.
"""

import numpy as np

from service.scans.points.cloud import Cloud
from service.scans.points.rigid import applied, rigid_between

BINS = 11
"""The number of bins of each of the three angles, as in the paper."""
NEIGHBOURS = 48
"""The most neighbours of a histogram."""
MOST_MATCHES = 700
"""The most matches that are compared with each other."""
SEEDS, GROWN = 60, 12
"""The number of matches from which poses are made, and of the best poses that are grown."""
GROUP = 24
"""The number of matches that a pose is first fitted to."""
ANGLE = 0.35
"""The largest difference of the cosines between two normals in both scans."""
ALIKE = 0.7
"""The least cosine between the normals of two matched points."""
APART_CELLS, APART_COSINE = 3.0, np.cos(np.radians(12))
"""Two poses are different if they place the middle this many cells apart, or are turned by more than 12 degrees."""


def fpfh(cloud: Cloud, radius: float) -> np.ndarray:
    """Return the histogram of each point in a radius, metres: [n, 33] float32, of length 1 in each of three angles; 0 if it is alone."""
    index, distance = cloud.tree.nearest(cloud.points, NEIGHBOURS + 1)
    near = (distance > 0) & (distance < radius)
    simple = _simple(cloud, index, distance, near)
    weight = np.where(near, 1 / np.maximum(distance, 1e-12), 0)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    full = simple + np.einsum("nk,nkb->nb", weight, simple[index], optimize=True)
    parts = full.reshape(-1, 3, BINS)
    length = np.linalg.norm(parts, axis=2, keepdims=True)
    return (parts / np.maximum(length, 1e-12)).reshape(-1, 3 * BINS).astype(np.float32)


def _simple(cloud: Cloud, index: np.ndarray, distance: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the histograms of the angles between each point and its neighbours alone, [n, 33]."""
    along = (cloud.points[index] - cloud.points[:, None]) / np.maximum(distance, 1e-12)[..., None]
    u = np.broadcast_to(cloud.normals[:, None], along.shape)
    other = cloud.normals[index]
    swap = np.abs(np.einsum("nki,nki->nk", u, along)) < np.abs(np.einsum("nki,nki->nk", other, along))  # the frame is at the steeper end
    first, second = np.where(swap[..., None], other, u), np.where(swap[..., None], u, other)
    along = np.where(swap[..., None], -along, along)
    phi = np.einsum("nki,nki->nk", first, along)
    v = np.cross(first, along)
    v /= np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
    w = np.cross(first, v)
    alpha = np.einsum("nki,nki->nk", v, second)
    theta = np.arctan2(np.einsum("nki,nki->nk", w, second), np.einsum("nki,nki->nk", first, second)) / np.pi
    rows = np.broadcast_to(np.arange(len(index))[:, None], index.shape)
    out = np.zeros((len(index), 3 * BINS))
    for number, angle in enumerate((alpha, phi, theta)):
        binned = np.clip(((angle + 1) / 2 * BINS).astype(np.int64), 0, BINS - 1) + number * BINS
        out += np.bincount((rows * 3 * BINS + binned)[near], minlength=out.size).reshape(out.shape)
    return out / np.maximum(near.sum(axis=1, keepdims=True), 1)


def rough_poses(a: Cloud, b: Cloud, features_a: np.ndarray, features_b: np.ndarray, *, cell_m: float, most: int) -> list[np.ndarray]:
    """Return rough poses a_from_b [4, 4], the best first, each different from the others: fewer than `most`, or none, if few have matches.

    The scans are thinned to cells of a side, metres; the features of their points are [n, 33].
    """
    at, of = _matches(features_a, features_b)
    if len(at) < 3:
        return []
    target, source, normals_a, normals_b = a.points[at], b.points[of], a.normals[at], b.normals[of]
    tolerance = 1.5 * cell_m
    apart_a, apart_b = _distances(target), _distances(source)
    agree = (np.abs(apart_a - apart_b) < tolerance) & (np.abs(normals_a @ normals_a.T - normals_b @ normals_b.T) < ANGLE)
    agree &= np.minimum(apart_a, apart_b) > 2 * cell_m
    first = agree.astype(np.float32)
    second = (first @ first) * first
    seeds = np.argsort(-second.sum(axis=1), kind="stable")[:SEEDS]
    group = np.argsort(-second[seeds], axis=1, kind="stable")[:, :GROUP]
    group = np.concatenate([seeds[:, None], group], axis=1)
    weights = np.take_along_axis(second[seeds], group, axis=1).astype(np.float64)
    weights[:, 0] = weights.max(axis=1)
    poses = rigid_between(source[group], target[group], weights)
    for _ in range(3):
        turn = poses[:, :3, :3].transpose(0, 2, 1)
        off = (source @ turn + poses[:, None, :3, 3] - target).reshape(-1, 3)
        alike = ((normals_b @ turn) * normals_a).reshape(-1, 3) @ np.ones(3)
        inside = ((off * off) @ np.ones(3) < tolerance**2) & (alike > ALIKE)
        inside = inside.reshape(len(poses), -1)
        support = inside.sum(axis=1)
        best = np.argsort(-support, kind="stable")[:GROWN]
        best = best[support[best] >= 3]
        if not best.size:
            return []
        inside, support = inside[best], support[best]
        poses = rigid_between(np.broadcast_to(source, (len(best), *source.shape)), np.broadcast_to(target, (len(best), *target.shape)),
                              inside.astype(np.float64))
    return _different(poses, support, b.middle, cell_m, most)


def _matches(features_a: np.ndarray, features_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of points that are each other's nearest in their features, and of the best of the others."""
    product = features_a @ features_b.T
    distance = (features_a**2).sum(axis=1)[:, None] + (features_b**2).sum(axis=1)[None] - 2 * product
    to_b, to_a = distance.argmin(axis=1), distance.argmin(axis=0)
    both = [(np.arange(len(features_a)), to_b), (to_a, np.arange(len(features_b)))]
    at, of = (np.concatenate([pair[k] for pair in both]) for k in (0, 1))
    pairs, times = np.unique(at * len(features_b) + of, return_counts=True)
    at, of = np.divmod(pairs, len(features_b))
    order = np.lexsort((distance[at, of], -times))[:MOST_MATCHES]
    return at[order], of[order]


def _distances(points: np.ndarray) -> np.ndarray:
    square = (points**2).sum(axis=1)
    return np.sqrt(np.maximum(square[:, None] + square[None] - 2 * points @ points.T, 0))


def _different(poses: np.ndarray, support: np.ndarray, middle: np.ndarray, cell_m: float, most: int) -> list[np.ndarray]:
    kept: list[np.ndarray] = []
    for number in np.argsort(-support, kind="stable"):
        pose = poses[number]
        if not any(is_near(pose, other, middle, APART_CELLS * cell_m) for other in kept):
            kept.append(pose)
        if len(kept) == most:
            break
    return kept


def is_near(pose: np.ndarray, other: np.ndarray, middle: np.ndarray, apart_m: float) -> bool:
    """Return whether two poses place the middle less than a length apart and are turned against each other by less than 12 degrees."""
    turn = (np.trace(pose[:3, :3].T @ other[:3, :3]) - 1) / 2
    shift = applied(pose, middle[None]) - applied(other, middle[None])
    return bool(turn > APART_COSINE and np.linalg.norm(shift) < apart_m)
