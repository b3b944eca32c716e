"""Fast point feature histograms: what the surface around a point looks like, whatever the pose.

Source: Rusu, Blodow and Beetz, "Fast Point Feature Histograms (FPFH) for 3D registration", ICRA 2009.
"""

import numpy as np

from service.scans.points.cloud import Cloud

BINS = 11
"""The number of bins of each of the three angles, as in the paper."""
NEIGHBOURS = 48
"""The most neighbours of a histogram."""


def fpfh(cloud: Cloud, radius: float) -> np.ndarray:
    """Return the histogram of each point, [n, 33] float32, of length 1 in each of the three angles; 0 of a point without neighbours.

    Args:
        radius: of the neighbourhood, metres.
    """
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
