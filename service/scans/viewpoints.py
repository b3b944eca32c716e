"""Where the scanner stood, for scans whose files do not say it.

A scan from one place hides nothing of itself: along the lines of sight each point is the nearest. So the direction to a scanner is one
along which hardly any point lies behind another. From behind the same holds nearly as well, so that the side is told otherwise: by the
normals of the file, or by the rims of the surface, at which a body turns away from who looks. Where these two contradict each other the
normals are flipped or the surface is hollow, as a bowl is, and nothing is told, unless the origin decides for the normals. Scans of one
device stand mostly in its own frame, and are judged together.

Source: the hull test of hidden points is Katz, Tal and Basri, "Direct visibility of point sets", SIGGRAPH 2007; here points are compared
    in cells across the direction, for the scanner is taken to be far away.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from stage.transforms import fibonacci_sphere

DIRECTIONS = 600
"""Directions that are tried, 8° apart."""
MOST_POINTS = 8000
"""Points of a scan that are looked at."""
LEAST_POINTS = 3
"""Fewer points span no surface."""
CELL, BEHIND = 2.0, 3.0
"""Sides of cells in distances between points, and the depth in cells from which a point is hidden by another of its cell."""
SAME_RAY = 0.5
"""Points lie on one ray from the origin if their rays are so near in distances between rays."""
MOST_HIDDEN = 0.05
"""The part of the points of a scan that may seem hidden: of surfaces seen at grazing angles a little does."""
SHARP = 0.01
"""Directions count by exp(-hidden / SHARP)."""
SURE, LEAST = 3.0, 0.1
"""The side is told if its evidence, the mean of a cosine, is so many standard errors from none over the scans, and at least so large."""
NEIGHBOURS, OFF_CENTRE = 16, 0.3
"""A point is on a border if the mean of so many neighbours lies so far to one side, in their distance."""
FAR = 20.0
"""The distance of the place that is written, in extents of the scan."""


class Viewpoints(NamedTuple):
    """Where scans were seen from."""

    place: np.ndarray | None  # [scans, 3] float64, the scanner in the frame of each scan, in the unit of the points; None: it is not told
    spread_degrees: float
    """How far directions that explain the scans as well lie apart; 0 for the origin."""
    reason: str
    """How it was found, or why it was not, in words."""
    contradicted: bool = False
    """Whether it was not found because normals and rims tell opposite sides."""


def find_viewpoints(scans: Sequence[np.ndarray], normals: Sequence[np.ndarray | None]) -> Viewpoints:
    """Find the place of the scanner of each scan: the origin if all scans can be seen from it, else a place far away along a direction.
    `scans`: points [n, 3] of each, in its frame. `normals`: [n, 3] of each as its file has them, or None."""
    if (fewest := min(map(len, scans))) < LEAST_POINTS:
        return Viewpoints(None, 180.0, f"a scan has {fewest} points, and {LEAST_POINTS} are the fewest that tell a direction")
    drawn = [np.random.default_rng(0).permutation(len(points))[:MOST_POINTS] for points in scans]
    few = [points[chosen] for points, chosen in zip(scans, drawn, strict=True)]
    far = _far_away(few, [None if each is None else each[chosen] for each, chosen in zip(normals, drawn, strict=True)])
    towards_origin = -np.array([points.mean(axis=0) for points in few])
    # from within half a shell, too, little is hidden: there a place far away explains the scan, on the other side
    if not far.contradicted and (far.place is None or ((far.place + towards_origin) * towards_origin).sum() > 0) and all(
            map(_seen_from_origin, few)):
        return Viewpoints(np.zeros((len(scans), 3)), 0.0, "seen from the origin of its file, no scan hides much of itself")
    return far


def _far_away(scans: Sequence[np.ndarray], normals: Sequence[np.ndarray | None]) -> Viewpoints:
    """Return places far away along the directions from which the scans hide least of themselves."""
    tried = fibonacci_sphere(DIRECTIONS)
    middles = np.array([points.mean(axis=0) for points in scans])
    far = FAR * np.array([np.ptp(points, axis=0).max() for points in scans])[:, None]
    hidden = np.array([_hidden(points - middle, tried) for points, middle in zip(scans, middles, strict=True)])  # [scans, directions]
    together = hidden.mean(axis=0)
    one = together.min() <= MOST_HIDDEN  # one device, whose scans have one side
    if not one and hidden.min(axis=1).max() > MOST_HIDDEN:
        return Viewpoints(None, 180.0, f"seen from any side, {hidden.min(axis=1).max():.0%} of the points of a scan hide behind others: "
                                       "it was not scanned from one place")
    found = [_middle(tried, together)] * len(scans) if one else [_middle(tried, each) for each in hidden]
    directions, spread = np.array([direction for direction, _ in found]), max(spread for _, spread in found)
    least = together.min() if one else hidden.min(axis=1).max()
    how = f"along {'one direction' if one else 'a direction for each'}, seen from far away, {least:.1%} of the points hide behind others"
    sides = {}
    for name, evidence in (("normals of the files", _by_normals(directions, normals)), ("rims of the surfaces", np.array(
            [_rims(points, np.tile(towards, (len(points), 1))) for points, towards in zip(scans, directions, strict=True)]))):
        if evidence is None:
            continue
        middle, error = float(evidence.mean()), float(evidence.std() / np.sqrt(max(len(evidence) - 1, 1)))
        if abs(middle) > max(SURE * error, LEAST) if one else (np.abs(evidence) > LEAST).all():
            sides[name] = np.sign(np.full_like(evidence, middle) if one else evidence)[:, None]
    if not sides:
        return Viewpoints(None, spread, f"{how}, from behind as from before, and nothing tells the side")
    name, side = next(iter(sides.items()))
    faces_origin = all(((directions * side) * -middles).sum(axis=1) > 0) and all(map(_open_to_origin, scans))
    if any((other != side).any() for other in sides.values()) and not faces_origin:
        return Viewpoints(None, spread, "the normals of the files tell one side and the rims of the surfaces the other: the normals look "
                                        "flipped, or the surface is hollow as a bowl is", contradicted=True)
    return Viewpoints(middles + far * directions * side, spread, f"{how}; the {name} tell the side")


def _middle(tried: np.ndarray, hidden: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the mean of the directions that hide least, with those opposite turned over, and how far they spread, degrees."""
    best = tried[hidden.argmin()]
    weight = np.exp(-(hidden - hidden.min()) / SHARP)
    sided = tried * np.sign(tried @ best)[:, None]
    mean = (weight[:, None] * sided).sum(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length, float(np.degrees(np.sqrt(2 * max(1 - length / weight.sum(), 0.0))))


def _hidden(points: np.ndarray, tried: np.ndarray) -> np.ndarray:
    """Return the part of points [n, 3] that lie behind others, seen along each direction."""
    step = float(np.median(cKDTree(points).query(points, k=min(5, len(points)))[0][:, -1]))
    side = max(CELL * step, 1e-9 * float(np.ptp(points)) + 1e-300)
    found = []
    for towards in tried:
        across = np.linalg.svd(towards[None])[2][1:]
        cell = np.floor(points @ across.T / side).astype(np.int64)
        cell -= cell.min(axis=0)
        _, index = np.unique(cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1], return_inverse=True)
        depth = points @ towards
        nearest = np.full(index.max() + 1, -np.inf)
        np.maximum.at(nearest, index, depth)
        found.append(float((nearest[index] - depth > BEHIND * side).mean()))
    return np.array(found)


def _seen_from_origin(points: np.ndarray) -> bool:
    """Return whether points [n, 3] can be a scan from the origin: few lie behind others, and the rims turn away from it."""
    return _open_to_origin(points) and _rims(points, -points / np.linalg.norm(points, axis=1)[:, None]) > LEAST


def _open_to_origin(points: np.ndarray) -> bool:
    """Return whether few of points [n, 3] lie behind others, seen from the origin."""
    reach = np.linalg.norm(points, axis=1)
    if not reach.min() > 0:
        return False
    ray = points / reach[:, None]
    distance, index = cKDTree(ray).query(ray, k=min(NEIGHBOURS + 1, len(points)))
    step = float(np.median(distance[:, min(4, distance.shape[1] - 1)]))
    behind = (distance < SAME_RAY * step) & (reach[:, None] - reach[index] > BEHIND * step * reach[:, None])
    return bool(behind.any(axis=1).mean() <= MOST_HIDDEN)


def _by_normals(directions: np.ndarray, normals: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Return the mean cosine of the normals to each direction, or None where a scan has none."""
    if any(each is None for each in normals):
        return None
    return np.array([float((each @ towards).mean()) for each, towards in zip(normals, directions, strict=True) if each is not None])


def _rims(points: np.ndarray, towards: np.ndarray) -> float:
    """Return the mean cosine between normals at the borders of a surface, turned towards the scanner, and the way out over the border.
    `towards` [n, 3]: the direction from each point to the scanner. Where a body hides its own back its normals lean outwards; seen from
    the back they would lean inwards."""
    distance, index = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)))
    around = points[index] - points[:, None]
    mean = around.mean(axis=1)
    spread = np.einsum("nki,nkj->nij", around, around) / around.shape[1] - mean[:, :, None] * mean[:, None]
    normal = np.linalg.eigh(spread)[1][:, :, 0]
    normal *= np.sign((normal * towards).sum(axis=1))[:, None]
    inwards = mean - normal * (mean * normal).sum(axis=1)[:, None]
    out = (mean * towards).sum(axis=1)[:, None] * towards - mean
    length = np.linalg.norm(out, axis=1)
    border = (np.linalg.norm(inwards, axis=1) > OFF_CENTRE * distance[:, -1]) & (length > 0)
    return float(((normal * out).sum(axis=1)[border] / length[border]).mean()) if border.any() else 0.0
