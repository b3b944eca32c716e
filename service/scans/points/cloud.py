"""The points of a scan as registration uses them: thinned, with normals, uncertainty and borders, at one scale."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from service.scans.points.neighbours import Neighbours
from service.scans.points.scan import Scan
from service.scans.points.squares import coarser

NEIGHBOURS, FEW_NEIGHBOURS = 16, 8
"""The number of neighbours that a normal is fitted to, and with which poses are fitted again, to see what the
choice does to them."""
OFF_CENTRE = 0.3
"""A point is on a border if the mean of its neighbours lies this part of their distance to one side."""
SPACING_NEIGHBOUR = 4
"""The spacing is the distance to the neighbour of this number: on a square grid the fourth is one step away."""
MOST_POINTS = 250_000
"""The most points that are kept of a scan; cells grow until no more are left."""
NOISE_CELLS = 3.0
"""Points are averaged in cells of this many σ: with closer points normals would be those of the noise."""


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """Points of one scan at one scale, in the scan's frame."""

    points: np.ndarray  # [n, 3] float64 metres
    normals: np.ndarray  # [n, 3] float64, unit, towards the camera
    near_normals: np.ndarray  # [n, 3] the same of fewer neighbours
    directions: np.ndarray  # [n, 3] float64, unit, from the camera
    sigma: np.ndarray  # [n] float64 metres along the line of sight
    spacing: np.ndarray  # [n] float64 metres to the neighbours
    border: np.ndarray  # [n] bool: the surface was seen on one side of the point alone
    tree: Neighbours
    sample: np.ndarray  # [m] int64, the points that are matched with other scans

    @property
    def middle(self) -> np.ndarray:
        """The mean of the points, [3] metres."""
        return self.points.mean(axis=0)


class Thinned(NamedTuple):
    """Points of a scan, one for each cell of a grid that holds some."""

    points: np.ndarray  # [n, 3] float64 metres
    directions: np.ndarray  # [n, 3] float64, unit, from the camera
    sigma: np.ndarray  # [n] float64 metres
    even: bool = True
    """True if points are as far apart on all of the surface."""


def thinned_scan(scan: Scan) -> Thinned:
    """Return at most `MOST_POINTS` points of a scan.

    A range image of many more pixels is taken in squares of pixels, which are larger where the surface is farther away. All else is taken
    in cells: means as far as the noise demands it, and one point of each where the number of points demands larger ones. The means of
    those would lie behind each convex surface, by more than their σ.
    """
    side = int(np.ceil(np.sqrt(len(scan.points) / MOST_POINTS)))
    squares = side > 2 and scan.camera is not None and scan.camera.projection == "perspective"
    points, directions, variance = _of_scan(coarser(scan, side) if squares else scan)
    cell = NOISE_CELLS * float(np.sqrt(np.median(variance)))
    thinned = thin(points, directions, variance, cell)
    kept = drawn = np.random.default_rng(0).permutation(len(thinned.points))  # in their order the first would be the lowest of the noise
    while len(kept) > MOST_POINTS:
        cell *= max(1.02, float(np.sqrt(len(kept) / MOST_POINTS)))
        kept = drawn[np.unique(cell_numbers(thinned.points[drawn], cell), return_index=True)[1]]
    kept = np.sort(kept)
    return Thinned(thinned.points[kept], thinned.directions[kept], thinned.sigma[kept], even=not squares)


def rough_scan(scan: Scan, thinned: Thinned, cell_m: float) -> Thinned:
    """Return the means of the points of a scan in cells of a side, metres, or of larger ones if the noise demands them.

    What `thinned_scan` made of the scan is taken in its place if it has far fewer points.
    """
    cell = max(cell_m, NOISE_CELLS * float(np.median(scan.sigma)))
    if len(scan.points) > MOST_POINTS:
        return thin(thinned.points, thinned.directions, thinned.sigma**2, cell)
    return thin(*_of_scan(scan), cell)


def _of_scan(scan: Scan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points of a scan, their directions [n, 3], and their variances along these [n]."""
    return scan.points.astype(np.float64), scan.directions(), scan.sigma.astype(np.float64) ** 2


def cloud_of(thinned: Thinned, *, most: int) -> Cloud:
    """Return points with their normals, spacing and borders.
    `most`: the most points that are matched with other scans; they are drawn evenly over the surface, and always the same."""
    tree = Neighbours(thinned.points)
    index, distance = tree.nearest(thinned.points, NEIGHBOURS + 1)
    around = thinned.points[index] - thinned.points[:, None]
    normals, spread, mean = _planes(around, thinned.directions)
    near_normals, _, _ = _planes(around[:, :FEW_NEIGHBOURS + 1], thinned.directions)
    off = np.linalg.norm(mean - normals * np.einsum("ni,ni->n", mean, normals)[:, None], axis=1)
    spacing = distance[:, min(SPACING_NEIGHBOUR, distance.shape[1] - 1)]
    border = (off > OFF_CENTRE * distance[:, -1]) | (spread[:, 1] < 0.05 * spread[:, 2])
    if thinned.even:
        order = np.random.default_rng(0).permutation(len(thinned.points))
    else:  # by the area that a point stands for (Efraimidis and Spirakis, Information Processing Letters 97, 2006)
        order = np.argsort(np.random.default_rng(0).exponential(size=len(spacing)) / np.maximum(spacing, 1e-12) ** 2, kind="stable")
    return Cloud(points=thinned.points, normals=normals, near_normals=near_normals, directions=thinned.directions, sigma=thinned.sigma,
                 spacing=spacing, border=border, tree=tree, sample=np.sort(order[:most]))


def _planes(around: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the normals [n, 3] of neighbours [n, k, 3], their variances along three directions [n, 3], and their mean [n, 3]."""
    mean = around.mean(axis=1)
    products = around.transpose(0, 2, 1) @ around / around.shape[1]
    spread, axes = np.linalg.eigh(products - mean[:, :, None] * mean[:, None, :])
    normals = axes[:, :, 0]
    return normals * np.where((normals * directions).sum(axis=1) > 0, -1.0, 1.0)[:, None], spread, mean


def thin(points: np.ndarray, directions: np.ndarray, variance: np.ndarray, cell: float) -> Thinned:
    """Return the means of points [n, 3] in cells of a side, metres, with the σ of the means; the variance is along the directions."""
    _, of_point, count = np.unique(cell_numbers(points, cell), return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(of_point, values, minlength=len(count)) / count

    averaged = np.stack([mean(column) for column in points.T], axis=1)
    middle = np.stack([mean(column) for column in directions.T], axis=1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    return Thinned(averaged, middle, np.sqrt(mean(variance) / count))


def cell_numbers(points: np.ndarray, cell: float) -> np.ndarray:
    """Return the number of the cell of each point [n, 3], [n] int64: of a grid of cells of a side, metres, around all points."""
    index = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    size = index.max(axis=0) + 1
    return index @ np.array([1, size[0], size[0] * size[1]])
