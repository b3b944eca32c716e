"""By which turn of all lights the slopes of a surface become those of one height.

Turned lights explain the images as well as the right ones: the normals are turned with them. But a surface has a height, so its slopes
run up to nothing around every closed way. Slopes of normals that are turned by ω change by terms that are products of slopes, and so they
run up to something, from which ω is found, three numbers. What strengths of lights and noise do to slopes is fitted beside, as a shear.

Source: Yuille and Snow, "Shape and albedo from multiple images using integrability", CVPR 1997, for what integrability tells of all lights
together; Belhumeur, Kriegman and Yuille, IJCV 35(1), 1999, for what it leaves open, which no turn is.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stage.capture.camera import Camera
from stage.spread import MAD_TO_SIGMA, between_blocks

MOST_ACROSS = 600
"""Pixels across an object as high as wide that are looked at."""
BOXES = 24
"""Boxes across an object as high as wide, around which slopes are summed up: noise cancels on the way, and many are left to be compared."""
LEAST_WIDTH, LEAST_BOXES = 2, 80
"""Least width of a box in pixels, and the number of boxes below which nothing is concluded."""
LEAST_TOWARD = 0.3
"""Least component of a normal towards the viewer of its pixel: towards the rim slopes and their noise grow without bound."""
ROUNDS, WEIGHTINGS, OUTLIER = 10, 20, 3.0
"""The most turns, each found after the one before was undone; fits of each, re-weighted; and standard deviations from which a box counts
less."""
SETTLED = np.radians(0.001)
"""Change of a turn after which no more is looked for."""
PRIOR, SUREST = 0.3, 2e-3
"""Standard deviation of turns (rad) and shears, which matters where a surface leaves some of them open, and of the surest slopes."""
LEAST_SQUARE, LEAST_SQUARE_STRICT = 100.0, 1000.0
"""Least square of a turn over its covariance: a turn of 5° has 100 to 3500 on real objects and noisy matt scenes, and thousands on
other matt ones. Right captures have up to 60, where light bounces up to 94, of broad highlights under lights from one side up to 500, and
240 under fewer than eight lights, where shadows and highlights, taken for shading, bend whole regions."""
LARGEST_SIGMA = np.radians(1.5)
"""Largest standard deviation of a turn about an axis: slopes that tell turns less well are bent by what the model lacks, and say more than
they know."""
LEAST_LESS = 4.0
"""Least sum over the boxes by which the costs of what is left drop, in the root of the sum of the squares of these drops: a turn
of 5° has 5 to 9 on real balls, one of 10° on matt scenes 11 or more."""
TURNS = np.array([[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float)
SHEARS = np.array([[[1, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 1, 0], [0, 0, 0], [0, 0, 0]]], float)
"""Changes of normals, [3, 3] each, that are fitted: turns about the axes, and what else integrability tells of a linear change."""


class Nearness(NamedTuple):
    """The surface under near lights, which stand aside of it as well where they turn about the centre of the object."""

    height: np.ndarray  # [rows, cols] camera-frame z, metres
    centre: np.ndarray  # [3] metres
    closeness: float
    """The mean inverse distance of the lights from the centre, per metre."""


class _Plane(NamedTuple):
    """The pixels that are looked at."""

    normal: np.ndarray  # [3, rows, cols]
    sway: np.ndarray  # [3, rows, cols] places from the centre of the object over the distance of the lights; [3, 1, 1] 0: these are far
    mask: np.ndarray  # [rows, cols] bool
    x: np.ndarray  # [rows, cols] coordinates on the plane at depth 1, or orthographic ones
    y: np.ndarray  # [rows, cols]
    perspective: bool
    width: int
    """Width of a box in pixels."""
    least: float
    """Standard deviation of what the slopes of the surest normals run up to around a box."""


class _Fit(NamedTuple):
    """The changes of all normals that take the most away of what slopes run up to."""

    changes: np.ndarray  # [changes]
    covariance: np.ndarray  # of the first three
    left: np.ndarray  # [boxes down, boxes across] what they leave; not a number where a box is not whole
    scale: float
    """Standard deviation of what is left."""


def turn_by_slopes(normal: np.ndarray, mask: np.ndarray, camera: Camera, near: Nearness | None = None, *,
                   strict: bool = False) -> tuple[Rotation, np.ndarray] | None:
    """Return the turn that brings the lights with which normals were solved to the right ones, and the covariance [3, 3] of its rotation
    vector; None where the surface does not say that they are turned.
    `normal`: [3, rows · cols] unit. `mask`: [rows, cols] bool, pixels that have one. `near`: None: the lights are far. `strict`: ask for
    more, where few lights gave the normals."""
    plane = _looked_at(normal, mask, camera, near)
    if plane is None:
        return None
    right = Rotation.identity()
    given = fit = _fit(plane, right, SHEARS)
    for _ in range(ROUNDS):
        fit = _fit(plane, right, np.concatenate([TURNS, SHEARS]))
        if fit is None:
            return None
        right = Rotation.from_rotvec(fit.changes[:3]) * right
        if np.abs(fit.changes[:3]).max() < SETTLED:
            break
    assert given is not None and fit is not None  # the former asks for less
    if (np.abs(fit.changes[:3]) > np.sqrt(np.diag(fit.covariance))).any():
        return None  # the last step does not end near the one before: turns about the axis of cylinders are told by their errors alone
    vector = right.as_rotvec()
    less = np.log1p((given.left / (OUTLIER * given.scale))**2) - np.log1p((fit.left / (OUTLIER * given.scale))**2)
    sure = np.diag(fit.covariance).max() < LARGEST_SIGMA**2 and np.nansum(less) > LEAST_LESS * np.sqrt(np.nansum(less**2))
    square = float(vector @ np.linalg.solve(fit.covariance, vector))
    return (right, fit.covariance) if sure and square > (LEAST_SQUARE_STRICT if strict else LEAST_SQUARE) else None


def _looked_at(normal: np.ndarray, mask: np.ndarray, camera: Camera, near: Nearness | None) -> _Plane | None:
    """Return every n-th pixel in both directions, of the rectangle around the object; None where no box has room."""
    step = max(1, round(np.sqrt(np.count_nonzero(mask)) / MOST_ACROSS))
    row, col = np.arange(0, mask.shape[0], step), np.arange(0, mask.shape[1], step)
    inside = mask[::step, ::step]
    width = max(LEAST_WIDTH, round(np.sqrt(np.count_nonzero(inside)) / BOXES))
    if min(inside.shape) <= width:
        return None
    x, y = camera.plane_at(*np.meshgrid(col[:2] + 0.5, row[:2] + 0.5))
    least = SUREST * float(np.hypot(x[0, 1] - x[0, 0], y[1, 0] - y[0, 0])) * np.sqrt(width)
    rows, cols = (_span(np.any(inside, axis=axis), width) for axis in (1, 0))
    row, col, inside = row[rows], col[cols], inside[rows, cols]
    x, y = camera.plane_at(*np.meshgrid(col + 0.5, row + 0.5))
    normal = normal.reshape(3, *mask.shape)[:, ::step, ::step][:, rows, cols].astype(np.float64)
    perspective = camera.projection == "perspective"
    sway = np.zeros((3, 1, 1))
    if near is not None:
        pixels = (row[:, None] * mask.shape[1] + col).reshape(-1)
        sway = near.closeness * (camera.points_at(pixels, near.height.reshape(-1)[pixels]) - near.centre).T.reshape(3, *x.shape)
    return _Plane(normal, sway, inside, x, y, perspective, width, least)


def _span(seen: np.ndarray, width: int) -> slice:
    """Return where something is seen, from one place before it on, and from the border of a box of the whole image."""
    places = np.flatnonzero(seen)
    return slice(max(0, (places[0] - 1) // width * width), places[-1] + 1) if len(places) else slice(0)


def _fit(plane: _Plane, turn: Rotation, changes: np.ndarray) -> _Fit | None:
    """Fit changes [changes, 3, 3] of normals that were turned so far; None: too little is seen."""
    whole = np.einsum("ij,jrc->irc", turn.as_matrix(), plane.normal + plane.sway)
    normal = whole - plane.sway
    toward = _toward(plane, normal)
    good = plane.mask & (toward > LEAST_TOWARD)
    slopes = np.where(good, -normal[:2] / np.where(good, toward, 1), 0)
    inside = _sums(~good, plane.width) == 0
    if np.count_nonzero(inside) < LEAST_BOXES:
        return None
    steep = _sums((slopes**2).sum(axis=0), plane.width)[inside] / (plane.width + 1)**2
    weight = (1 + steep)**-1.5  # as noise of slopes grows
    runs = []
    for change in changes:
        moved = np.einsum("ij,jrc->irc", change, whole)
        runs.append(_around(plane, np.where(good, -(moved[:2] + slopes * _toward(plane, moved)) / np.where(good, toward, 1), 0))[inside])
    by = np.stack(runs, axis=1) * weight[:, None]
    off = -_around(plane, slopes)[inside] * weight
    found = np.zeros(by.shape[1])
    for _ in range(WEIGHTINGS):
        left = off - by @ found
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(left))), plane.least)
        trust = 1 / (1 + (left / (OUTLIER * scale))**2)
        inverse = np.linalg.inv((by * trust[:, None]).T @ by + (scale / PRIOR)**2 * np.eye(len(found)))
        found = inverse @ ((by * trust[:, None]).T @ off)
    left = off - by @ found
    covariance = between_blocks(inverse, by * (trust * left)[:, None], *np.nonzero(inside))
    everywhere = np.full(inside.shape, np.nan)
    everywhere[inside] = left
    return _Fit(found, covariance[:3, :3], everywhere, scale)


def _toward(plane: _Plane, vectors: np.ndarray) -> np.ndarray:
    """Return the component of vectors [3, rows, cols] towards the viewer of each pixel, by which slopes are those of the logarithm of depth
    where the camera is a perspective one."""
    return vectors[2] - vectors[0] * plane.x - vectors[1] * plane.y if plane.perspective else vectors[2]


def _around(plane: _Plane, slopes: np.ndarray) -> np.ndarray:
    """Return what slopes [2, rows, cols] run up to around each box, [boxes down, boxes across]."""
    p, q = slopes
    along = np.pad(np.cumsum((p[:, 1:] + p[:, :-1]) / 2 * np.diff(plane.x, axis=1), axis=1), ((0, 0), (1, 0)))
    down = np.pad(np.cumsum((q[1:] + q[:-1]) / 2 * np.diff(plane.y, axis=0), axis=0), ((1, 0), (0, 0)))
    grid = slice(None, None, plane.width)
    return np.asarray(np.diff(np.diff(along[grid, grid], axis=1), axis=0) - np.diff(np.diff(down[grid, grid], axis=0), axis=1))


def _sums(values: np.ndarray, width: int) -> np.ndarray:
    """Return the sum of values [rows, cols] over each box, with its borders, [boxes down, boxes across]."""
    total = np.pad(np.cumsum(np.cumsum(values, axis=0, dtype=np.float64), axis=1), ((1, 0), (1, 0)))
    first = [np.arange(0, count - width, width) for count in values.shape]
    low, high = np.ix_(*first), np.ix_(*(start + width + 1 for start in first))
    return np.asarray(total[high] - total[low[0], high[1]] - total[high[0], low[1]] + total[low])
