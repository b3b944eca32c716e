"""Finds where a second camera sees the places of a projector that the first one sees, from the coordinates that both have decoded.

Each pixel of the second camera has decoded a column and a row; in the neighbourhood of a pixel they are nearly linear in the image. A
plane is fitted to each there, and the place at which both have the wanted values is where that pixel and the slopes of the planes say.
"""

from typing import NamedTuple

import numpy as np

REACH = 2
"""The window of the planes is this many pixels to every side: stripes as wide as a few pixels have slopes there too."""
STEP_TIMES = 4.0
"""A neighbour counts where its column and row differ by no more than this many times the usual difference for each pixel between."""
LEAST_NEIGHBOURS = 8
FARTHEST_PX = 0.8
"""The most pixels from the middle of the nearest pixel of the second camera to the place that it sees."""
PER_CELL = 12
"""The most pixels of the second camera that are compared in each cell of the search."""
SMALLEST_SLOPE = 0.02
"""The least determinant of the slopes, relative to its median: below it the place slides along the image."""


class CodedImage(NamedTuple):
    """The decoded coordinates of one camera."""

    column: np.ndarray  # [rows, cols] projector pixels
    row: np.ndarray  # [rows, cols]
    sigma_column: np.ndarray  # [rows, cols]
    sigma_row: np.ndarray  # [rows, cols]
    solved: np.ndarray  # [rows, cols] bool


class Places(NamedTuple):
    """The places at which the second camera sees the pixels of the first."""

    u: np.ndarray  # [n] continuous image coordinates of the second camera
    v: np.ndarray  # [n]
    sigma_u: np.ndarray  # [n] pixels
    sigma_v: np.ndarray  # [n]
    found: np.ndarray  # [n] bool


def find_places(column: np.ndarray, row: np.ndarray, sigma_column: np.ndarray, sigma_row: np.ndarray, other: CodedImage) -> Places:
    """Find the places of the projector in the image of a second camera.

    Args:
        column, row: [n] of the first camera, projector pixels, with their standard deviations.
        other: what the second camera has decoded.
    """
    count = len(column)
    nothing = Places(np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count, dtype=bool))
    planes = _planes(other)
    if planes is None:
        return nothing
    place, value, slope, variance = planes
    spacing = float(np.sqrt(np.median(np.abs(np.linalg.det(slope)))))
    nearest, far = _nearest(np.stack([column, row], axis=1), value, 2 * max(spacing, 1e-6))
    inverse = np.linalg.inv(slope[nearest])
    wanted = np.stack([column, row], axis=1) - value[nearest]
    moved = np.einsum("nij,nj->ni", inverse, wanted)
    spread = variance[nearest] + np.stack([sigma_column, sigma_row], axis=1) ** 2
    sigma = np.sqrt(np.einsum("nij,nj->ni", inverse**2, spread))
    found = np.isfinite(far) & (np.abs(moved).max(axis=1) <= FARTHEST_PX)
    at = place[nearest] + moved
    u, v, sigma_u, sigma_v = (np.where(found, values, 0) for values in (at[:, 0], at[:, 1], sigma[:, 0], sigma[:, 1]))
    return Places(u, v, sigma_u, sigma_v, found)


def _planes(other: CodedImage) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return [m, 2] image coordinates, [m, 2] columns and rows, [m, 2, 2] their slopes and [m, 2] variances of the pixels with planes."""
    solved = other.solved
    rows, cols = solved.shape
    if min(rows, cols) <= 2 * REACH or not solved.any():
        return None
    values = np.stack([other.column, other.row]).astype(np.float64)
    across, down = ((np.abs(np.diff(values, axis=axis)), np.logical_and(*_pairs(solved, axis - 1))) for axis in (2, 1))
    usual = np.array([max((float(np.median(step[number][both])) for step, both in (across, down) if both.any()), default=0.0)
                      for number in range(2)])
    usual = np.maximum(usual, 1e-3) + np.array([np.median(sigma[solved]) for sigma in (other.sigma_column, other.sigma_row)])
    inner = (slice(REACH, rows - REACH), slice(REACH, cols - REACH))
    middle = values[:, inner[0], inner[1]]
    gram = np.zeros((*middle.shape[1:], 3, 3))
    right = np.zeros((2, *middle.shape[1:], 3))
    squares, number = np.zeros(middle.shape), np.zeros(middle.shape[1:])
    for dy in range(-REACH, REACH + 1):
        for dx in range(-REACH, REACH + 1):
            part = (slice(REACH + dy, rows - REACH + dy), slice(REACH + dx, cols - REACH + dx))
            off = values[:, part[0], part[1]] - middle
            limit = STEP_TIMES * usual * max(abs(dx), abs(dy), 1)
            counts = (solved[part] & (np.abs(off) <= limit[:, None, None]).all(axis=0)).astype(np.float64)
            base = np.array([1.0, dx, dy])
            gram += counts[..., None, None] * np.outer(base, base)
            right += (counts * off)[..., None] * base
            squares += counts * off**2
            number += counts
    good = solved[inner] & (number >= LEAST_NEIGHBOURS) & (np.linalg.det(gram) > 1.0)
    if not good.any():
        return None
    inverse = np.linalg.inv(gram[good])
    fitted = np.einsum("nij,knj->kni", inverse, right[:, good])
    left = np.maximum(squares[:, good] - (fitted * right[:, good]).sum(axis=2), 0) / np.maximum(number[good] - 3, 1)
    sigmas = np.stack([sigma[inner][good] for sigma in (other.sigma_column, other.sigma_row)]).astype(np.float64)
    # the decoder's error or that of the plane, whichever is larger, over the pixels of the window
    variance = np.maximum(sigmas**2, left) * inverse[:, 0, 0]
    slope = np.moveaxis(fitted[:, :, 1:], 0, 1)
    determinant = np.abs(np.linalg.det(slope))
    kept = determinant > SMALLEST_SLOPE * np.median(determinant)
    if not kept.any() or np.median(determinant) <= 0:
        return None
    y, x = np.nonzero(good)
    place = np.stack([x + REACH + 0.5, y + REACH + 0.5], axis=1)
    value = (middle[:, good] + fitted[:, :, 0]).T
    return place[kept], value[kept], slope[kept], variance.T[kept]


def _pairs(solved: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return whether a pixel and the next along an axis are solved."""
    return (solved[:-1], solved[1:]) if axis == 0 else (solved[:, :-1], solved[:, 1:])


def _nearest(wanted: np.ndarray, values: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the nearest value to each wanted one, [n], and its squared distance, [n]; infinite where none is near."""
    low = np.minimum(values.min(axis=0), wanted.min(axis=0)) - cell
    stride = int(np.ceil((max(values[:, 1].max(), wanted[:, 1].max()) - low[1]) / cell)) + 3

    def key(points: np.ndarray) -> np.ndarray:
        numbers = np.floor((points - low) / cell).astype(np.int64)
        return numbers[:, 0] * stride + numbers[:, 1]

    own = key(values)
    order = np.argsort(own, kind="stable")
    sorted_keys, asked = own[order], key(wanted)
    best, nearest = np.full(len(wanted), np.inf), np.zeros(len(wanted), dtype=np.int64)
    for shift in (du * stride + dv for du in (-1, 0, 1) for dv in (-1, 0, 1)):
        first = np.searchsorted(sorted_keys, asked + shift)
        for offset in range(PER_CELL):
            at = np.minimum(first + offset, len(order) - 1)
            inside = sorted_keys[at] == asked + shift
            if not inside.any():
                break
            index = order[at]
            distance = np.where(inside, ((values[index] - wanted) ** 2).sum(axis=1), np.inf)
            closer = distance < best
            best, nearest = np.where(closer, distance, best), np.where(closer, index, nearest)
    return nearest, best
