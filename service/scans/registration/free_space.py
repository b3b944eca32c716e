"""Compare the points of one scan with the range image of another: seen, hidden behind the surface, or where the camera saw through."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion, maximum_filter, minimum_filter

from service.scans.points.cloud import Cloud
from service.scans.points.neighbours import Neighbours
from service.scans.points.rigid import applied, inverse
from service.scans.points.scan import Scan
from stage.capture.camera import Camera
from stage.spread import TUKEY

MOST_PIXELS = 1 << 19
"""Most pixels that are kept of a range image. Of a larger one squares of pixels are taken together, each with its nearest and farthest."""


class DepthRange(NamedTuple):
    """The nearest and farthest depth around each pixel of a range image, or around each square of pixels."""

    camera: Camera
    step: int
    """Side of a square in pixels."""
    nearest: np.ndarray  # [rows, cols] float32 metres, of squares; 0 where any pixel of the square or around it has no depth
    farthest: np.ndarray  # [rows, cols]


ALIKE_AROUND = 8
"""Neighbours of a point that are asked whether they are contradicted too."""
MOST_ALIKE = 0.75
"""Part of them that must be, for the point to count as one of a part of the surface: single points float before edges."""
FACING = 0.35
"""Cosine of the angle between the normal of a surface and a line of sight from which on the camera cannot have missed the surface: a sheet
seen edge-on lies between its pixels."""

RAYS, LEAST_RAYS, RAY_REACH = 6, 4, 1.5
"""Points of a set around a line of sight that are asked how far the surface is, fewest of them within `RAY_REACH` distances of neighbouring
points that tell it."""
HIDES, MOST_HIDDEN = 6.0, 0.1
"""A point is behind others of its set from so many distances of neighbours on. A set of which more than this part is was not seen from one
place, and says nothing."""

LEAST_SPREAD = 1e-3
"""Spread in radians of the lines of sight of a set, below which they are parallel and meet nowhere: of a scanner, a set of a hundredth of
its distance in size has three times that."""


class Sight(NamedTuple):
    """Numbers of points of one scan that another scan sees, or contradicts."""

    agreeing: int
    """Points on the surface that the camera measured."""
    contradicted: int
    """Points before that surface, where the camera saw through."""
    judged: int
    """Points that fall into the image at pixels with a depth."""

    @property
    def contradicted_part(self) -> float:
        """The contradicted part of the points on or before the surface."""
        return self.contradicted / max(self.agreeing + self.contradicted, 1)


class Contradiction(NamedTuple):
    """The parts of the points of two scans, on or before the surface of the other, that the other contradicts."""

    points: float
    """The part of all contradicted points."""
    surface: float
    """The part of the contradicted points on surface that the other camera cannot have missed."""
    before_sets: float
    """The part of the points that lie before the surface of sets of points, of those that their lines of sight pass."""


def depth_range(scan: Scan) -> DepthRange | None:
    """Return the range of depths around each pixel of a range image, or None for a set of points."""
    if scan.camera is None:
        return None
    depth = scan.image(-scan.points[:, 2].astype(np.float32))
    inner = binary_erosion(depth != 0, np.ones((3, 3)))
    low, high = (np.where(inner, extreme(depth, 3), 0) for extreme in (minimum_filter, maximum_filter))
    step = max(1, int(np.ceil(np.sqrt(depth.size / MOST_PIXELS))))
    return DepthRange(scan.camera, step, _of_squares(low, step, np.minimum), _of_squares(high, step, np.maximum))


def _of_squares(values: np.ndarray, step: int, least: np.ufunc) -> np.ndarray:
    """Return the least or largest of the values of each square of `step` pixels; beyond the border values are 0."""
    if step == 1:
        return values
    rows, cols = (-(-side // step) for side in values.shape)
    padded = np.zeros((rows * step, cols * step), dtype=values.dtype)
    padded[:values.shape[0], :values.shape[1]] = values
    return np.asarray(least.reduce(padded.reshape(rows, step, cols, step), axis=(1, 3)))


def sight(image: DepthRange, points: np.ndarray, pose: np.ndarray, tolerance: np.ndarray | float) -> Sight:
    """Compare points of another scan with what a range image says of the space before and behind its surface.
    `pose`: [4, 4] from the frame of the points to that of the image. `tolerance`: [n] metres: how far before the surface a point may lie
    without a contradiction."""
    before, on, judged = _seen(image, points, pose, tolerance)
    return Sight(int(on.sum()), int(before.sum()), int(judged.sum()))


def _seen(image: DepthRange, points: np.ndarray, pose: np.ndarray, tolerance: np.ndarray | float
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which points lie before the surface of a range image, on it, and at pixels with a depth; arguments as of `sight`."""
    placed = applied(pose, points)
    row, col, inside = image.camera.pixels_of(placed)
    at = row // image.step, col // image.step
    near, far = image.nearest[at], image.farthest[at]
    judged = inside & (near != 0)
    depth = -placed[:, 2]
    before = judged & (depth < near - tolerance)
    return before, judged & ~before & (depth <= far + tolerance), judged


def contradiction(a: DepthRange | None, b: DepthRange | None, cloud_a: Cloud, cloud_b: Cloud, pose: np.ndarray, tolerance: float
                  ) -> Contradiction:
    """Return which parts of the points in sight lie where the other camera or scanner saw through, at a pose a_from_b.

    A point is not contradicted by less than its own σ explains. On a part of the surface lie points whose neighbours are contradicted too,
    that are on no border and that the other camera does not see edge-on: where a pixel takes in the edge of a surface and what is behind
    it, its point lies on neither.
    """
    through = contradicted = in_sight = before_sets = on_sets = 0
    for image, own, cloud, way in ((a, cloud_a, cloud_b, pose), (b, cloud_b, cloud_a, inverse(pose))):
        if image is None:
            of_set = _seen_by_set(own, cloud.points[cloud.sample], way, tolerance)
            before_sets, on_sets = before_sets + of_set.contradicted, on_sets + of_set.agreeing
            continue
        before, on, _ = _seen(image, cloud.points, way, np.maximum(tolerance, TUKEY * cloud.sigma))
        at = np.flatnonzero(before & ~cloud.border)
        at = at[_facing(image, cloud.points[at], cloud.normals[at], way) > FACING]
        if len(at):
            around, _ = cloud.tree.nearest(cloud.points[at], ALIKE_AROUND + 1)
            through += int((before[around[:, 1:]].mean(axis=1) >= MOST_ALIKE).sum())
        contradicted += int(before.sum())
        in_sight += int(before.sum() + on.sum())
    return Contradiction(contradicted / max(in_sight, 1), through / max(in_sight, 1), before_sets / max(before_sets + on_sets, 1))


def _seen_by_set(cloud: Cloud, points: np.ndarray, pose: np.ndarray, tolerance: float) -> Sight:
    """Compare points of another scan with a set of points, from where its lines of sight come together; arguments as of `sight`."""
    own = cloud.points[cloud.sample]
    spacing = float(np.median(cloud.spacing)) * float(np.sqrt(len(cloud.points) / len(own)))
    across = np.eye(3) - cloud.directions[cloud.sample][:, :, None] * cloud.directions[cloud.sample][:, None, :]
    together = across.sum(axis=0)
    if np.linalg.eigvalsh(together)[0] < LEAST_SPREAD**2 * len(own):
        return Sight(0, 0, 0)
    origin = np.linalg.solve(together, (across @ own[:, :, None]).sum(axis=0)[:, 0])
    length = np.linalg.norm(own - origin, axis=1)
    if not length.min() > 0:
        return Sight(0, 0, 0)
    rays, reach = Neighbours((own - origin) / length[:, None]), RAY_REACH * spacing / float(np.median(length))

    def ranges(of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        far = np.linalg.norm(of - origin, axis=1)
        index, apart = rays.nearest((of - origin) / np.maximum(far, np.finfo(np.float64).tiny)[:, None], RAYS)
        near = apart < reach
        least, most = (np.where(near, length[index], none) for none in (np.inf, -np.inf))
        return far, least.min(axis=1), most.max(axis=1), near.sum(axis=1) >= LEAST_RAYS

    far, least, _, _ = ranges(own)
    if (far - least > HIDES * spacing).mean() > MOST_HIDDEN:
        return Sight(0, 0, 0)
    far, least, most, judged = ranges(applied(pose, points))
    before = judged & (far < least - tolerance - spacing)
    return Sight(int((judged & ~before & (far <= most + tolerance + spacing)).sum()), int(before.sum()), int(judged.sum()))


def _facing(image: DepthRange, points: np.ndarray, normals: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the cosine of the angle, up to 90°, between the normal of each point and the line of sight of a range image."""
    to_camera = -applied(pose, points) if image.camera.projection == "perspective" else np.array([[0.0, 0.0, 1.0]])
    along = np.abs((normals @ pose[:3, :3].T * to_camera).sum(axis=1))
    return np.asarray(along / np.maximum(np.linalg.norm(to_camera, axis=1), 1e-12))


def both_sights(a: DepthRange | None, b: DepthRange | None, points_a: np.ndarray, points_b: np.ndarray, pose: np.ndarray,
                tolerance: float) -> Sight:
    """Return the sum of what both scans say of each other's points at a pose a_from_b; a set of points, None, says nothing."""
    parts = [sight(a, points_b, pose, tolerance)] if a is not None else []
    parts += [sight(b, points_a, inverse(pose), tolerance)] if b is not None else []
    return Sight(*(sum(values) for values in zip(*parts, strict=True))) if parts else Sight(0, 0, 0)
