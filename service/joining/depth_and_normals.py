"""Depth and normals of one view joined: the shape of the normals where the depth is noisy, the depth where normals drift.

The surface is cut where depth shows steps that the normals do not explain, the normals are integrated between the cuts, each part is
placed by its depths, and what is left of the difference corrects heights and normals scale by scale, as far as it is error of the
normals and not noise of the depth.

The difference of the two maps is averaged over cells of 2^l pixels, from the largest scale to the smallest. What cells differ by beyond
the noise of the noisy map, which is known, is the error of the other at that scale; each cell is corrected by the part of its
difference that is error and not noise, S / (S + N), and the next smaller scale sees what is left.

Source: Nehab, Rusinkiewicz, Davis and Ramamoorthi, "Efficiently combining positions and normals for precise 3D geometry", SIGGRAPH 2005,
which filters with one fixed scale in place of the noise and error of each; the shrinkage is that of Wiener (1949), with the variance of
the error estimated from the data at each scale (empirical Bayes, Efron and Morris, "Stein's estimation rule and its competitors", 1973).
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.surface.integrate import IntegrationOptions, integrate_normals
from kernels.surface.slopes import STEEPEST
from service.joining.depth_steps import SLOPE_ERROR, Edges, find_steps
from stage.spread import MAD_TO_SIGMA

LEAST_DEPTHS = 12
"""Number of depths by which a part is placed; one with fewer has no place of its own."""
PASSES = 2
"""Number of times each scale is looked at: cells are interpolated, which leaves part of a correction undone."""
REJECTED = 5.0
"""Difference from its surroundings, in robust standard deviations, beyond which a reading is left out."""
SURROUNDINGS = 3
"""Scale of these surroundings, cells of 2^3 pixels."""


class Joined(NamedTuple):
    """A surface from depth and normals."""

    height: np.ndarray  # [rows, cols] float32 camera-frame z, 0 where there is no normal
    sigma: np.ndarray  # [rows, cols] float32 standard error of the height; 0 where it has no place
    normal: np.ndarray  # [3, rows, cols] float32, corrected; 0 where there was none
    part: np.ndarray  # [rows, cols] int, pixels of one number are connected across no break; -1: no normal there
    placed: np.ndarray  # [rows, cols] bool, where depth tells the height
    rejected: np.ndarray  # [rows, cols] bool, depths that are mixtures of two surfaces, or contradict those around them
    guessed: np.ndarray  # [rows, cols] bool, beside a step without a depth of its own: which side it belongs to is a guess
    unexplained: float | None
    """Part of the variance of the depths within parts, without their noise, that the integrated normals leave; None: there is none."""


def join_depth(normal: np.ndarray, normal_sigma: np.ndarray, solved: np.ndarray, depth: np.ndarray, depth_sigma: np.ndarray,
               measured: np.ndarray, x: np.ndarray, y: np.ndarray, *, perspective: bool, device: str,
               progress: Callable[[float], None] | None = None) -> Joined:
    """Join the depth map and the normal map of one camera.
    Raises ArrayError if shapes do not fit, fewer than LEAST_DEPTHS pixels have both, or values are not finite or not positive where they
    must be.

    Args:
        normal: [3, rows, cols] unit, camera frame.
        normal_sigma: [rows, cols] standard errors of the normals, radians.
        solved: [rows, cols] bool, where there is a normal.
        depth: [rows, cols] −z of the camera frame, above 0 for a perspective camera.
        depth_sigma: [rows, cols] standard deviations of the depth, above 0 and independent between pixels.
        measured: [rows, cols] bool, where there is a depth.
        x, y: [rows, cols] plane coordinates of the pixels, as for `integrate_normals`.
    """
    _check(normal, normal_sigma, solved, depth, depth_sigma, measured, perspective=perspective)
    plane = _Plane(x.astype(np.float64), y.astype(np.float64), perspective)
    both = solved & measured
    u, u_sigma = plane.to_heights(-depth.astype(np.float64), both), plane.to_sigmas(depth, depth_sigma, both)
    slopes = plane.slopes(np.where(solved, normal, 0).astype(np.float64))
    error = plane.slope_error(slopes, normal_sigma + SLOPE_ERROR)
    cuts = find_steps(u, u_sigma, both, *(_edges(plane, normal, slopes, error, solved, axis) for axis in (1, 0)))
    mean_z = -float(np.median(depth[measured]))
    found = integrate_normals(normal.astype(np.float32), solved, x.astype(np.float32), y.astype(np.float32), perspective=perspective,
                              mean_z=mean_z, sigma=np.degrees(normal_sigma), cuts=(cuts.right, cuts.down),
                              options=IntegrationOptions(discontinuities=True), device=device, progress=progress)
    part = found.part
    assert part is not None
    base = plane.to_heights(to_numpy(found.height).astype(np.float64), solved)
    part = np.where(solved, part, -1)
    correction, variance = np.zeros(solved.shape), np.zeros(solved.shape)
    placed, rejected = np.zeros(solved.shape, dtype=bool), both & ~cuts.depth
    known, relief, left = both & cuts.depth, 0.0, 0.0
    for box, here in _parts(part):
        seen = here & known[box]
        if seen.sum() < LEAST_DEPTHS:
            continue
        fixed = correct(u[box] - base[box], u_sigma[box], seen, here)
        for target, values in ((correction, fixed.value), (variance, fixed.variance)):
            target[box][here] = values[here]
        placed[box][here] = True
        rejected[box][fixed.rejected] = True
        used = seen & ~fixed.rejected
        relief += _variation(u[box][used], u_sigma[box][used])
        left += _variation((u - base)[box][used], u_sigma[box][used])
    corrected = plane.turned(normal.astype(np.float64), slopes, correction, part, solved)
    z = np.where(placed, plane.to_z(base + correction), 0)
    sigma = np.where(placed, plane.to_depth_sigmas(z, np.sqrt(variance)), 0)
    unplaced = solved & ~placed
    if unplaced.any():
        known_z = z[placed].mean() if placed.any() else mean_z
        z = np.where(unplaced, to_numpy(found.height) + (known_z - mean_z), z)
    return Joined(z.astype(np.float32), sigma.astype(np.float32), corrected.astype(np.float32), part, placed, rejected, cuts.guessed,
                  None if relief == 0 else left / relief)


def _variation(values: np.ndarray, sigma: np.ndarray) -> float:
    """Return the sum of squares about the mean, in units of the noise, without what noise makes of it: above 3 of its standard deviations,
    else 0."""
    weight = 1 / sigma**2
    found = float((weight * (values - np.average(values, weights=weight)) ** 2).sum())
    expected = len(values) - 1
    return found - expected if found > expected + 3 * np.sqrt(2 * expected) else 0.0


class _Plane:
    """Conversions between camera-frame z and heights in pixels' distances: of z (orthographic) or of −log depth (perspective)."""

    def __init__(self, x: np.ndarray, y: np.ndarray, perspective: bool) -> None:
        self._x, self._y, self._perspective = x, y, perspective
        self.spacing = float(np.hypot(np.diff(x, axis=1), np.diff(y, axis=1)).mean()) if x.shape[1] > 1 else 1.0
        self._gradients = [_differences(plane) for plane in (x, y)]

    def to_heights(self, z: np.ndarray, there: np.ndarray) -> np.ndarray:
        return np.where(there, -np.log(np.where(there, -z, 1)) if self._perspective else z, 0) / self.spacing

    def to_z(self, heights: np.ndarray) -> np.ndarray:
        return -np.exp(-heights * self.spacing) if self._perspective else heights * self.spacing

    def to_sigmas(self, depth: np.ndarray, sigma: np.ndarray, there: np.ndarray) -> np.ndarray:
        scale = np.where(there, depth, 1) * self.spacing if self._perspective else self.spacing
        return np.where(there, sigma / scale, 1)

    def to_depth_sigmas(self, z: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        return sigma * self.spacing * (np.abs(z) if self._perspective else 1)

    def slopes(self, normal: np.ndarray) -> np.ndarray:
        """Return [2, rows, cols] derivatives along x and y of spacing · heights that the normals have."""
        toward = normal[2] - (normal[0] * self._x + normal[1] * self._y if self._perspective else 0)
        return -normal[:2] / np.maximum(toward, STEEPEST)

    def slope_error(self, slopes: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Return [rows, cols] the error of a step to a neighbour, in its distance, for an error of the angle."""
        return sigma * (1 + (slopes**2).sum(axis=0))

    def rise(self, slopes: np.ndarray, axis: int) -> np.ndarray:
        """Return the rises over the edges along an axis by the mean slope of both ends, in pixels' distances."""
        step = [np.diff(plane, axis=axis) for plane in (self._x, self._y)]
        mean = [(_head(s, axis) + _tail(s, axis)) / 2 for s in slopes]
        return (mean[0] * step[0] + mean[1] * step[1]) / self.spacing

    def turned(self, normal: np.ndarray, slopes: np.ndarray, correction: np.ndarray, part: np.ndarray, solved: np.ndarray) -> np.ndarray:
        """Return the normals with the slopes of a correction, in pixels' distances, added."""
        along = [_within(correction, part, axis) for axis in (1, 0)]  # per column, per row
        (x_col, x_row), (y_col, y_row) = ((g[0], g[1]) for g in self._gradients)
        determinant = x_col * y_row - x_row * y_col
        added = self.spacing * np.stack([along[0] * y_row - along[1] * y_col, along[1] * x_col - along[0] * x_row]) / determinant
        new = slopes + added
        third = 1 - (new[0] * self._x + new[1] * self._y if self._perspective else np.zeros(solved.shape))
        turned = np.stack([-new[0], -new[1], third])
        turned /= np.linalg.norm(turned, axis=0)
        return np.where(solved & (added != 0).any(axis=0), turned, np.where(solved, normal, 0))


def _edges(plane: _Plane, normal: np.ndarray, slopes: np.ndarray, error: np.ndarray, solved: np.ndarray, axis: int) -> Edges:
    """Return the edges along an axis, 1 for those to the right."""
    joined = _head(solved, axis) & _tail(solved, axis)
    turn = np.linalg.norm(np.diff(np.where(solved, normal, 0), axis=1 + axis), axis=0)
    values = (np.where(joined, plane.rise(slopes, axis), 0), np.maximum(_head(error, axis), _tail(error, axis)), turn, joined)
    after = [(0, int(axis == 0)), (0, int(axis == 1))]
    return Edges(*(np.pad(each, after) for each in values))


def _head(plane: np.ndarray, axis: int) -> np.ndarray:
    return plane[:, :-1] if axis == 1 else plane[:-1]


def _tail(plane: np.ndarray, axis: int) -> np.ndarray:
    return plane[:, 1:] if axis == 1 else plane[1:]


def _differences(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return central differences per column and per row."""
    def along(axis: int) -> np.ndarray:
        return np.gradient(plane, axis=axis) if plane.shape[axis] > 1 else np.ones_like(plane)

    return along(1), along(0)


def _within(values: np.ndarray, part: np.ndarray, axis: int) -> np.ndarray:
    """Return differences per pixel along an axis, central where both neighbours are of the pixel's part, one-sided where one is, else 0."""
    total, count = np.zeros(values.shape), np.zeros(values.shape)
    step = np.diff(values, axis=axis)
    same = (_head(part, axis) == _tail(part, axis)) & (_head(part, axis) >= 0)
    for ends in (_head, _tail):
        ends(total, axis)[...] += np.where(same, step, 0)
        ends(count, axis)[...] += same
    return total / np.maximum(count, 1)


def _parts(part: np.ndarray) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Yield the box of each part and [rows, cols] of it where the part is, the part of the smallest number first."""
    rows, cols = np.nonzero(part >= 0)
    labels = part[rows, cols]
    order = np.argsort(labels, kind="stable")
    bounds = np.flatnonzero(np.diff(labels[order], prepend=-1))
    for begin, end in zip(bounds, [*bounds[1:], len(order)], strict=True):
        members = order[begin:end]
        box = (slice(int(rows[members].min()), int(rows[members].max()) + 1), slice(int(cols[members].min()), int(cols[members].max()) + 1))
        yield box, part[box] == labels[members[0]]


def _check(normal: np.ndarray, normal_sigma: np.ndarray, solved: np.ndarray, depth: np.ndarray, depth_sigma: np.ndarray,
           measured: np.ndarray, *, perspective: bool) -> None:
    shape = solved.shape
    if normal.shape != (3, *shape):
        raise ArrayError(f"normal has shape {normal.shape}, solved {shape}: give [3, rows, cols]")
    for name, plane in (("normal_sigma", normal_sigma), ("depth", depth), ("depth_sigma", depth_sigma), ("measured", measured)):
        if plane.shape != shape:
            raise ArrayError(f"{name} has shape {plane.shape}, solved {shape}: give one value per pixel")
    if (count := int((solved & measured).sum())) < LEAST_DEPTHS:
        raise ArrayError(f"{count} pixels have both a depth and a normal: {LEAST_DEPTHS} are needed")
    if not (np.isfinite(depth[measured]).all() and np.isfinite(normal[:, solved]).all()):
        raise ArrayError("depth and normals must be finite where they are known")
    if perspective and (depth[measured] <= 0).any():
        raise ArrayError("a depth before a perspective camera must be above 0")
    if not (depth_sigma[measured] > 0).all():
        raise ArrayError("the standard deviation of a depth must be above 0")


class Correction(NamedTuple):
    """The correction of the smooth map."""

    value: np.ndarray  # [rows, cols]
    variance: np.ndarray  # [rows, cols] of the error that is left
    rejected: np.ndarray  # [rows, cols] bool, readings that disagree with their surroundings


def correct(
    difference: np.ndarray,  # [rows, cols] noisy minus smooth
    sigma: np.ndarray,  # [rows, cols] standard deviation of the noise, independent between pixels
    known: np.ndarray,  # [rows, cols] bool, where there is a difference; one pixel or more
    inside: np.ndarray,  # [rows, cols] bool, where the correction is wanted
) -> Correction:
    """Estimate the error of a smooth map from its difference to a noisy one."""
    rejected = _outliers(difference, sigma, known)
    weight = np.where(known & ~rejected, 1 / sigma**2, 0)
    value = np.full(difference.shape, (weight * np.where(known, difference, 0)).sum() / weight.sum())
    variance = np.full(difference.shape, 1 / weight.sum())
    cover = inside.astype(np.float64)
    levels = max(1, int(np.ceil(np.log2(max(difference.shape)))))
    for level in range(levels - 1, -1, -1):
        for again in range(PASSES):
            weights = _sum_cells(weight, level)
            left = _sum_cells(weight * np.where(known, difference - value, 0), level) / np.where(weights > 0, weights, 1)
            whole = weights.sum()
            cells = (weights > 0).sum()
            noise = cells / whole  # mean of 1 / weights, weighted like the differences
            error = max((weights * left**2).sum() / whole - noise, 0.0)
            if again == 0:  # as much error as the noise may hide
                hidden = error + noise * np.sqrt(2 / cells)
                variance += _spread(hidden / (1 + hidden * weights), cover, level)
            if error == 0:
                break
            value += _spread(error * weights / (error * weights + 1) * left, cover, level)
    return Correction(value, variance, rejected)


def _outliers(difference: np.ndarray, sigma: np.ndarray, known: np.ndarray) -> np.ndarray:
    weight = np.where(known, 1 / sigma**2, 0)
    weights = _sum_cells(weight, SURROUNDINGS)
    mean = _sum_cells(weight * np.where(known, difference, 0), SURROUNDINGS) / np.where(weights > 0, weights, 1)
    off = (difference - _interpolated(mean, weights, difference.shape, SURROUNDINGS)) / sigma
    spread = max(1.0, MAD_TO_SIGMA * float(np.median(np.abs(off[known]))))
    return known & (np.abs(off) > REJECTED * spread)


def _sum_cells(plane: np.ndarray, level: int) -> np.ndarray:
    """Return the sums over cells of 2^level pixels."""
    side = 1 << level
    rows, cols = (-(-count // side) for count in plane.shape)
    framed = np.pad(plane, ((0, rows * side - plane.shape[0]), (0, cols * side - plane.shape[1])))
    return framed.reshape(rows, side, cols, side).sum(axis=(1, 3))


def _spread(cells: np.ndarray, cover: np.ndarray, level: int) -> np.ndarray:
    """Return the pixels between the middles of cells; cells without a pixel inside do not count."""
    return _interpolated(cells, (_sum_cells(cover, level) > 0).astype(np.float64), cover.shape, level)


def _interpolated(cells: np.ndarray, weight: np.ndarray, shape: tuple[int, int], level: int) -> np.ndarray:
    """Return bilinear interpolation of cells by their weights; 0 where all are 0."""
    held = (weight > 0).astype(np.float64)
    total, norm = (_bilinear(plane, shape, level) for plane in (cells * held, held))
    return total / np.where(norm > 0, norm, 1)


def _bilinear(cells: np.ndarray, shape: tuple[int, int], level: int) -> np.ndarray:
    for axis, count in enumerate(shape):
        place = np.clip((np.arange(count) + 0.5) / (1 << level) - 0.5, 0, cells.shape[axis] - 1)
        low = np.minimum(place.astype(np.int64), max(cells.shape[axis] - 2, 0))
        part = (place - low).reshape((-1, 1) if axis == 0 else (1, -1))
        cells = np.take(cells, low, axis) * (1 - part) + np.take(cells, np.minimum(low + 1, cells.shape[axis] - 1), axis) * part
    return cells
