"""Test whether the normals of a surface fit together, or would after a mirroring or a turn of their axes.

Light directions whose axes are mirrored or turned explain the images as well as the right ones: the normals are mirrored or turned
with them. But a surface has a height, so its slopes p = dz/dx and q = dz/dy obey dp/dy = dq/dx. With M the derivatives of the
slopes, a mirrored surface has dp/dy + dq/dx = 0 instead, and one that is turned by a right angle dp/dx + dq/dy = 0. A surface that
is turned by 180 degrees obeys the first rule too: that is the ambiguity of convex and concave, for service.light_estimation.object_outline.

Source: Horn, "Robot Vision", 1986, section 11.8, for integrability; Belhumeur, Kriegman and Yuille, IJCV 35(1), 1999, for what it
leaves open.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly

SITES = 2000
"""Most places, spread over the object, at which the slopes are differentiated."""
LEAST_SITES = 200
"""Fewer places decide nothing."""
LINES = 1000
"""Places are looked for on about this many rows or columns, which bounds the memory of large images."""
STEPS_ACROSS = 60
"""The two pixels of a difference are a thirtieth of the object's size apart: noise matters less than next to each other."""
LEAST_TOWARD = 0.15
"""Least n_z of a pixel whose slope is used: towards the rim slopes and their noise grow without bound."""
CHANGING, MANY = 0.2, 95
"""Places count whose slopes change by this part of what they do at the percentile, LEAST_SITES at the least: within a plane they change by
noise alone, and of stairs and gears under exchanged axes, which are planes but for their edges, planes made 0.9 of the violation. Under few
lights, which may turn whole regions, every place counts."""
STANDARD_ERRORS_MIRROR, STANDARD_ERRORS_TURN = 6.0, 8.0
"""Least difference of the terms in standard errors of their mean. Neighbouring places are not independent: on right captures a mirroring
is ahead by 2.4 at most (a white bowl under four lights) and behind by 10 to 40 on most; a turn is ahead by 10.7, but below 21 degrees."""
LARGEST_PART = 0.85
"""The terms of the right axes are at most this part of those of the wrong ones."""
LARGEST_PART_STRICT, LARGEST_LEFT_STRICT = 0.5, 0.1
"""The part, and the most that the correction may leave, where three to five lights gave the normals: shadows and highlights then turn
whole regions, and the normals of bowls and bare metal fit another mirroring better by chance (0.42 of it, but 0.12 left)."""
LEAST_TURN_DEGREES = 30.0
"""Smaller turns are the bias of a few unevenly placed lights."""
SNAP_DEGREES = 25.0
"""Turns this near to a right angle are taken as right angles."""


class Axes(NamedTuple):
    """The correction of the axes of the lights, and so of the normals, in the image plane, up to a turn by 180 degrees."""

    matrix: np.ndarray  # [2, 2] float64, orthogonal
    misfit: float
    """Mean squared violation of integrability as given, of 1: 0 on a smooth surface, 0.25 for normals of no order."""
    left: float
    """The same with the correction."""


def sites(mask: np.ndarray) -> np.ndarray:  # -> [4, sites] int64
    """Return places spread over a mask: the row-major positions of the pixels to the right, to the left, above and below.
    `mask`: [rows, cols] bool, pixels that have a normal."""
    step = max(1, round(np.sqrt(np.count_nonzero(mask)) / STEPS_ACROSS))
    rows, cols = mask.shape
    if min(rows, cols) <= 2 * step:
        return np.zeros((4, 0), dtype=np.int64)
    middle = slice(step, -step)
    whole = mask[middle, 2 * step :] & mask[middle, : -2 * step] & mask[2 * step :, middle] & mask[: -2 * step, middle]
    skip = max(1, min(whole.shape) // LINES)
    row, col = skip * np.array(np.nonzero(whole[::skip, ::skip]))
    chosen = evenly(len(row), SITES)
    row, col = row[chosen], col[chosen]
    centre = (row + step) * cols + col + step
    return np.stack([centre + step, centre - step, centre - step * cols, centre + step * cols])


def wrong_axes(normals: np.ndarray, *, strict: bool = False) -> Axes | None:
    """Return the mirroring or turn after which the normals fit together clearly better, or None.

    At every place where the slopes change, the four sums and differences of their derivatives are scaled to the length 1, so that edges
    and rims count no more than other places. Their mean squares then say how far each rule is broken, and the turn with the least is an
    eigenvector of a 2 by 2 matrix.
    `normals`: [4, 3, sites] at the pixels of `sites`, z towards the viewer of that pixel. `strict`: ask for more, where few lights gave
    the normals."""
    good = (normals[:, 2] > LEAST_TOWARD).all(axis=0)
    if good.sum() < LEAST_SITES:
        return None
    right, left, above, below = (-normals[:, :2] / np.where(good, normals[:, 2:], 1))[:, :, good].astype(np.float64)
    (px, qx), (py, qy) = right - left, above - below
    terms = np.stack([py - qx, px + qy, py + qx, px - qy])
    change = np.sqrt((terms**2).sum(axis=0))
    least = 0.0 if strict else min(CHANGING * np.percentile(change, MANY), np.partition(change, -LEAST_SITES)[-LEAST_SITES])
    counts = change >= least
    terms = terms[:, counts] / np.maximum(change[counts], 1e-300)
    turned, turn = _least(terms[:2])
    mirrored, mirror = _least(terms[2:])
    given = terms[0] ** 2
    part, most = (LARGEST_PART_STRICT, LARGEST_LEFT_STRICT) if strict else (LARGEST_PART, 1.0)
    if _ahead(mirrored, turned) > STANDARD_ERRORS_MIRROR and mirrored.mean() < min(part * turned.mean(), most):
        cosine, sine = _snapped(mirror)
        return Axes(np.array([[cosine, -sine], [-sine, -cosine]]), float(given.mean()), float(mirrored.mean()))
    turned_degrees = abs(np.degrees(np.arctan2(turn[1], turn[0])))
    if (turned_degrees > LEAST_TURN_DEGREES and _ahead(turned, given) > STANDARD_ERRORS_TURN
            and turned.mean() < min(part * given.mean(), most)):
        cosine, sine = _snapped(turn)
        return Axes(np.array([[cosine, sine], [-sine, cosine]]), float(given.mean()), float(turned.mean()))
    return None


def _least(pair: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squares of the unit combination of two terms whose mean square is least, [sites], and its factors [2]."""
    factors = np.linalg.eigh(pair @ pair.T)[1][:, 0]
    factors = factors if factors[0] >= 0 else -factors
    return (factors @ pair) ** 2, factors


def _ahead(one: np.ndarray, other: np.ndarray) -> float:
    """Return by how many standard errors the mean of `one` is below that of `other`."""
    difference = other - one
    return float(difference.mean() / max(difference.std() / np.sqrt(len(difference)), 1e-300))


def _snapped(factors: np.ndarray) -> tuple[float, float]:
    """Return cosine and sine of a direction, of a right angle if it is near one."""
    degrees = np.degrees(np.arctan2(factors[1], factors[0]))
    nearest = 90 * np.round(degrees / 90)
    angle = np.radians(nearest if abs(degrees - nearest) < SNAP_DEGREES else degrees)
    return float(np.cos(angle)), float(np.sin(angle))
