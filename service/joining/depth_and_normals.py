"""Depth and normals of one view joined: the shape of the normals where the depth is noisy, the depth where normals drift.

The surface is cut where depth shows steps that the normals do not explain, the normals are integrated between the cuts, each part is
placed by its depths, and what is left of the difference corrects heights and normals scale by scale, as far as it is error of the
normals and not noise of the depth.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.surface.integrate import IntegrationOptions, integrate_normals
from kernels.surface.slopes import STEEPEST
from service.joining.correction import correct
from service.joining.depth_steps import SLOPE_ERROR, Edges, find_steps
from service.joining.relief import fine_relief, relief_factor, relief_shift_px
from service.joining.rounding import rounding_step
from service.light_estimation.lambertian import degrees_between
from stage.spread import MAD_TO_SIGMA

LEAST_DEPTHS = 12
"""Number of depths by which a part is placed; one with fewer has no place of its own."""
TURN = 0.05
"""Angle, radians, by which normals are turned about the image's axes to tell what turned lights make of their heights."""
ROUNDED = np.sqrt(12)
"""A step over the standard deviation of errors that are uniform over it."""
MOST_NOISE, MOST_EDGES = 1000.0, 300_000
"""The largest factor of the noise that is looked for, and the edges that tell it."""


class Joined(NamedTuple):
    """A surface from depth and normals."""

    height: np.ndarray  # [rows, cols] float32 camera-frame z, 0 where there is no normal
    sigma: np.ndarray  # [rows, cols] float32 standard error of the height; 0 where it has no place
    normal: np.ndarray  # [3, rows, cols] float32, corrected; 0 where there was none
    part: np.ndarray  # [rows, cols] int, pixels of one number are connected across no break; -1: no normal there, or a step on every side
    placed: np.ndarray  # [rows, cols] bool, where depth tells the height
    rejected: np.ndarray  # [rows, cols] bool, depths that are mixtures of two surfaces, lie alone, or contradict those around them
    guessed: np.ndarray  # [rows, cols] bool, beside a step without a depth of its own: which side it belongs to is a guess
    unexplained: float | None
    """Part of the variance of the relief of the depths, without their noise, that the integrated normals leave beside what a tilt of 5° or
    of their σ makes: of the fine relief, or of all where there is none; None: there is no relief."""
    step_m: float
    """Median step to which depths are rounded; 0 where they are not."""
    noise_factor: float
    """By which the noise of the depths exceeds their standard deviations, with their rounding."""
    factor: float
    """By which the relief of the depth exceeds that of the normals; 1 where it is not sure to."""
    shift_px: tuple[float, float]
    """By how much the depth lies to the right and down against the normals, which it was moved back by; 0 where it is not sure."""
    shared_m: float
    """Standard deviation of errors that neighbouring depths share."""
    one_sided_m: float
    """By how much wrong depths that are too near to be rejected pull the surface to one side; 0 where it is not sure that they do."""
    contradicted_degrees: float
    """Median angle by which the smooth part of the depth turns the normals; 0 where errors as normals have them explain it."""


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
    own_error = plane.slope_error(slopes, normal_sigma)
    error = plane.slope_error(slopes, normal_sigma + SLOPE_ERROR)
    right, down = (_edges(plane, normal, slopes, error, solved, axis) for axis in (1, 0))
    rounding = rounding_step(u, both, right, down)
    u_sigma = np.hypot(u_sigma, rounding / ROUNDED)
    noise_factor = noise_over_sigma(u, u_sigma, both, right, down)
    u_sigma = u_sigma * noise_factor
    cuts = find_steps(u, u_sigma, both, right, down)
    mean_z = -float(np.median(depth[measured]))
    integrated = partial(integrate_normals, mask=solved, x=x.astype(np.float32), y=y.astype(np.float32), perspective=perspective,
                         mean_z=mean_z, sigma=np.degrees(normal_sigma), cuts=(cuts.right, cuts.down),
                         options=IntegrationOptions(discontinuities=True), device=device)
    found = integrated(normal.astype(np.float32), progress=progress)
    part = found.part
    assert part is not None
    base = plane.to_heights(to_numpy(found.height).astype(np.float64), solved)
    part = np.where(solved, part, -1)
    correction, variance = np.zeros(solved.shape), np.zeros(solved.shape)
    known = both & cuts.depth & (part >= 0)  # a pixel with a step on every side is of no part
    placed, rejected = np.zeros(solved.shape, dtype=bool), both & ~known
    unlike, left, shared, one_sided = np.zeros(2), np.zeros(2), 0.0, 0.0
    angle = max(SLOPE_ERROR, float(np.median(normal_sigma[solved])))
    largest = int(np.bincount(part[known]).argmax()) if known.any() else -1
    factor = relief_factor(u, u_sigma, base, known & (part == largest), part)
    base = base * factor
    shift_px = relief_shift_px(u, u_sigma, base, known & (part == largest), part)
    if any(shift_px):  # lights that are turned look alike where surfaces are round
        turned = (np.einsum("ij,jrc->irc", Rotation.from_rotvec(axis).as_matrix(), normal) for axis in TURN * np.eye(3)[:2])
        drifts = [plane.to_heights(to_numpy(integrated(other.astype(np.float32)).height).astype(np.float64), solved) - base
                  for other in turned]
        shift_px = relief_shift_px(u, u_sigma, base, known & (part == largest), part, drifts)
    shifted = np.zeros(base.shape)  # by how much heights differ from those that are shifted
    if any(shift_px):
        shifted = np.asarray(sum(np.gradient(base, axis=axis) * way for axis, way in zip((1, 0), shift_px, strict=True)))
    u = u + shifted
    for box, here in _parts(part):
        seen = here & known[box]
        if seen.sum() < LEAST_DEPTHS:
            continue
        fixed = correct(u[box] - base[box], u_sigma[box], seen, here, slope_error=float(np.median(own_error[box][here])))
        for target, values in ((correction, fixed.value), (variance, fixed.variance)):
            target[box][here] = values[here]
        shared, one_sided = max(shared, fixed.shared), max(one_sided, fixed.one_sided)
        placed[box][here] = True
        rejected[box][fixed.rejected] = True
        used = seen & ~fixed.rejected
        tilts = (np.tan(angle) * place for place in np.indices(used.shape))
        for total, heights, share in ((unlike, u[box], 1.0), (left, (u - base)[box], 1.0), *((left, tilt, -0.5) for tilt in tilts)):
            total += [share * _variation(each[used], u_sigma[box][used]) for each in (heights, fine_relief(heights, used))]
    variance += shifted**2
    turn = degrees_between(normal, plane.turned(normal.astype(np.float64), slopes, correction, part, solved))[placed]
    contradicted = float(np.median(turn)) if turn.size else 0.0
    if contradicted <= np.degrees(angle):
        contradicted = 0.0
    disputed = (1 - 1 / factor) * base + (correction if contradicted else 0)
    if placed.any():  # which of the two is right, and where their surfaces meet, is unknown
        variance += (apart := (disputed - disputed[placed].mean()) ** 2) + apart[placed].mean()
    corrected = plane.turned(normal.astype(np.float64), slopes, correction + (1 - 1 / factor) * base, part, solved)
    z = np.where(placed, plane.to_z(base + correction), 0)
    sigma = np.where(placed, plane.to_depth_sigmas(z, np.sqrt(variance)), 0)
    unplaced = solved & ~placed
    if unplaced.any():
        known_z = z[placed].mean() if placed.any() else mean_z
        z = np.where(unplaced, to_numpy(found.height) + (known_z - mean_z), z)
    step_m, shared_m, one_sided_m = (float(plane.to_depth_sigmas(np.array(mean_z), np.array(error)))
                                     for error in (np.median(rounding[both]), shared, one_sided))
    return Joined(z.astype(np.float32), sigma.astype(np.float32), corrected.astype(np.float32), part, placed, rejected, cuts.guessed,
                  _unexplained(unlike, left), step_m, noise_factor, factor, shift_px,
                  shared_m, one_sided_m, contradicted)


def _variation(values: np.ndarray, sigma: np.ndarray) -> float:
    """Return the sum of squares about the mean, in units of the noise, without what noise makes of it: above 3 of its standard deviations,
    else 0."""
    weight = 1 / sigma**2
    found = float((weight * (values - np.average(values, weights=weight)) ** 2).sum())
    expected = len(values) - 1
    return found - expected if found > expected + 3 * np.sqrt(2 * expected) else 0.0


def _unexplained(unlike: np.ndarray, left: np.ndarray) -> float | None:
    """Return the part of the variation of depths, [whole, fine], that is left."""
    scale = 1 if unlike[1] > 0 else 0
    return float(max(left[scale], 0) / unlike[scale]) if unlike[scale] > 0 else None


def noise_over_sigma(value: np.ndarray, sigma: np.ndarray, known: np.ndarray, right: Edges, down: Edges) -> float:
    """Return by which factor the noise of heights exceeds their standard deviations, 1 or more: of what neighbours differ by beyond the
    slopes of the normals and the error of these.

    The arguments are those of `find_steps`.
    """
    squares, noise, slope = [], [], []
    for edges, axis in ((right, 1), (down, 0)):
        held = _head(known & edges.joined, axis) & _tail(known, axis)
        squares.append((np.diff(value, axis=axis) - _head(edges.slope, axis))[held] ** 2)
        noise.append((_head(sigma, axis) ** 2 + _tail(sigma, axis) ** 2)[held])
        slope.append(_head(edges.sigma, axis)[held] ** 2)
    found, own, other = (np.concatenate(each) for each in (squares, noise, slope))
    found, own, other = (each[::max(1, len(found) // MOST_EDGES)] for each in (found, own, other))

    def beyond(factor: float) -> float:
        return MAD_TO_SIGMA * float(np.sqrt(np.median(found / (factor**2 * own + other)))) - 1

    return 1.0 if not len(found) or beyond(1.0) <= 0 else float(brentq(beyond, 1.0, MOST_NOISE)) if beyond(MOST_NOISE) < 0 else MOST_NOISE


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
