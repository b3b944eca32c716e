"""Boxes of the lattice of voxels, each so small that the pixels of the views that can see it fit into memory.

A brick is one box where few pixels can see it. Elsewhere it is cut into eight boxes, and these again: the smaller a box, the smaller the
part of each image in which it lies.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from kernels.fusion.bricks import BLOCK, BRICK, BRICK_VOXELS
from service.scans.fusion.range_images import PreparedScan

MOST_PIXELS = 4_000_000
"""Pixels of all views together above which a box is cut: some 200 bytes each while it is computed."""
LEAST_BLOCKS = 4
"""Blocks along each side of the smallest boxes: of smaller ones the blocks behind their high sides would be more than they are."""
LEAST_VOXELS = LEAST_BLOCKS * BLOCK
"""Voxels along each side of the smallest boxes."""
WINDOW_PIXELS = 4
"""Pixels around the window of a view in which a box can lie."""
NEAREST_M = 1e-4
"""Distance of the plane before a camera behind which nothing is asked for, metres."""
BORDER_POINTS = 33
"""Points along each side of a window that are projected through the distortion of a camera."""
VOXELS_BEFORE, VOXELS_BEHIND = 4, 12
"""Voxels around a box that the views must be asked for: a block more on its high sides, and what lies beside their voxels."""


class Watching(NamedTuple):
    """A scan that can see a box, and the part of its image in which the box can lie."""

    number: int
    scan: PreparedScan
    window: tuple[int, int, int, int]  # first and last row, first and last column

    @property
    def pixels(self) -> int:
        """The number of pixels in the window."""
        top, bottom, left, right = self.window
        return (bottom - top) * (right - left)


class Box(NamedTuple):
    """A cube of blocks of voxels."""

    corner: tuple[int, int, int]  # lattice coordinates, in voxels, of the lowest voxel
    blocks: int  # along each side
    chosen: np.ndarray  # [n] int64, which of the given places lie in it
    watching: list[Watching]


def boxes(places: np.ndarray, scans: list[PreparedScan], voxel: float, origin: np.ndarray) -> Iterator[Box]:
    """Yield the boxes in which places lie and that a scan can see, brick by brick.

    Args:
        places: [n, 3] integer lattice coordinates, in voxels.
        origin: of the lattice, [3] metres.

    Convention:
        The boxes follow from the cameras and the places alone, so that all workers cut alike.
    """
    bricks, number = np.unique(places // BRICK_VOXELS, axis=0, return_inverse=True)
    order = np.argsort(number.ravel(), kind="stable")
    for brick, chosen in zip(bricks, np.split(order, np.cumsum(np.bincount(number.ravel()))[:-1]), strict=True):
        yield from _cut(brick * BRICK_VOXELS, BRICK, chosen, places, list(enumerate(scans)), voxel, origin)


def _cut(corner: np.ndarray, blocks: int, chosen: np.ndarray, places: np.ndarray, scans: list[tuple[int, PreparedScan]], voxel: float,
         origin: np.ndarray) -> Iterator[Box]:
    """Yield a box, or those that it is cut into."""
    low = origin + corner * voxel
    high = low + blocks * BLOCK * voxel
    watching = watching_views(scans, low - VOXELS_BEFORE * voxel, high + VOXELS_BEHIND * voxel)
    if blocks <= LEAST_BLOCKS or sum(each.pixels for each in watching) <= MOST_PIXELS:
        x, y, z = map(int, corner)
        if watching:
            yield Box((x, y, z), blocks, chosen, watching)
        return
    half = blocks // 2
    octant = (places[chosen] - corner) // (half * BLOCK)
    for step in np.ndindex(2, 2, 2):
        if (there := (octant == step).all(axis=1)).any():
            yield from _cut(corner + half * BLOCK * np.array(step), half, chosen[there], places,
                            [(number, scan) for number, scan, _ in watching], voxel, origin)


def watching_views(scans: Iterable[tuple[int, PreparedScan]], low: np.ndarray, high: np.ndarray) -> list[Watching]:
    """Return the scans, given with their numbers, that can see a box of the world from its lowest to its highest corner, [3] metres."""
    found = ((number, scan, _window(scan, low, high)) for number, scan in scans)
    return [Watching(number, scan, window) for number, scan, window in found if window is not None]


def _window(scan: PreparedScan, low: np.ndarray, high: np.ndarray) -> tuple[int, int, int, int] | None:
    """Return the first and last rows and columns in which a box can lie, or None where the view cannot see it."""
    corners = np.array([[(low, high)[side][axis] for axis, side in enumerate(sides)] for sides in np.ndindex(2, 2, 2)])
    there = corners @ scan.image.camera_from_world[:3, :3].T + scan.image.camera_from_world[:3, 3]
    rows, cols = scan.image.depth.shape
    if not scan.image.orthographic:
        there = _in_front(there)
        if len(there) == 0:
            return None
    x, y = scan.camera.plane_at(*_border(0.0, cols, 0.0, rows))
    seen = there[:, :2] if scan.image.orthographic else there[:, :2] / -there[:, 2:]
    first, last = np.maximum(seen.min(axis=0), (x.min(), y.min())), np.minimum(seen.max(axis=0), (x.max(), y.max()))
    if (first > last).any():
        return None
    x, y = _border(first[0], last[0], first[1], last[1])
    u, v = scan.camera.image_coordinates(np.stack([x, y, np.full_like(x, -1.0)], axis=-1))
    first_row, last_row = int(np.floor(v.min())) - WINDOW_PIXELS, int(np.ceil(v.max())) + WINDOW_PIXELS
    first_col, last_col = int(np.floor(u.min())) - WINDOW_PIXELS, int(np.ceil(u.max())) + WINDOW_PIXELS
    box = max(first_row, 0), min(last_row, rows), max(first_col, 0), min(last_col, cols)
    return box if box[1] - box[0] > 1 and box[3] - box[2] > 1 else None


def _in_front(corners: np.ndarray) -> np.ndarray:
    """Return the corners [n, 3] of what lies in front of a camera of a box, whose corners [8, 3] differ in one bit along each edge."""
    before = corners[:, 2] <= -NEAREST_M
    found = [corners[before]]
    for one, other in ((one, one | bit) for bit in (1, 2, 4) for one in range(8) if not one & bit):
        if before[one] != before[other]:
            share = (-NEAREST_M - corners[one, 2]) / (corners[other, 2] - corners[one, 2])
            found.append((corners[one] + share * (corners[other] - corners[one]))[None])
    return np.concatenate(found)


def _border(left: float, right: float, top: float, bottom: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points along the border of a rectangle, of which the outermost are those of the whole, whatever the distortion."""
    along = np.linspace(0.0, 1.0, BORDER_POINTS)
    u, v = left + (right - left) * along, top + (bottom - top) * along
    return (np.concatenate([u, u, np.full_like(v, left), np.full_like(v, right)]),
            np.concatenate([np.full_like(u, top), np.full_like(u, bottom), v, v]))
