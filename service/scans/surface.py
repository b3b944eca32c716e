"""The surface of many range images, brick by brick, so that memory grows with the views that see one brick, not with the site.

The arrays of the scans lie in files that are mapped into memory. A brick takes from each view the window of pixels in which the brick can
lie. Bricks compute the lattice alike, so that their triangles share vertices where they meet. What the views show at such a vertex is
blended by the angle to the triangles around it, of which a brick has its own alone: the first brick that has the vertex decides.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels.fusion.bricks import BRICK_VOXELS, find_blocks
from kernels.fusion.extract import extract
from kernels.fusion.gather import gather
from kernels.fusion.integrate import integrate
from kernels.fusion.residuals import FUSED, LOST, REFUSED, residuals
from kernels.fusion.views import LEAST_COSINE, TRUNCATION_SIGMAS, TRUNCATION_VOXELS, ViewArrays, corners_of, upload_views
from service.asset.mesh import vertex_normals
from service.scans.range_images import NORMAL, PreparedScan, channels
from stage.frames import pixel_centres

WINDOW_PIXELS = 4
"""Pixels around the window of a view in which a brick can lie."""
HISTOGRAM_STEP, HISTOGRAM_END = 0.05, 20.0
"""Width and end of the bins, in standard deviations, in which residuals are counted."""
PHOTOMETRIC = 0.5
"""Length of the blended normal from which on it is mostly photometric: normals fitted to depths count a hundredth in it."""
NO_QUADS = np.zeros((0, 4), dtype=np.int32)


class Watching(NamedTuple):
    """A scan that can see a box, and the part of its image in which the box can lie."""

    number: int
    scan: PreparedScan
    window: tuple[int, int, int, int]  # first and last row, first and last column


class Surface(NamedTuple):
    """The fused surface."""

    points: np.ndarray  # [V, 3] float64 metres, world
    normals: np.ndarray  # [V, 3] float32, unit: of the views, where one sees the vertex, else of the faces
    sigma: np.ndarray  # [V] float32 metres
    seen: np.ndarray  # [V] uint16, scans that see each vertex
    photometric: np.ndarray  # [V] bool, whether the normal is mostly that of solved maps
    values: np.ndarray  # [V, C] float32, the blended layers behind the normal, each followed by its weight
    faces: np.ndarray  # [F, 3] int32
    tallies: list["Tally"]  # one a scan
    bricks: int
    blocks: int


class Tally:
    """How the pixels of one scan lie to the fused surface."""

    def __init__(self) -> None:
        """Begin without a pixel."""
        self.fused = self.lost = self.refused = 0
        self._counts = np.zeros(int(HISTOGRAM_END / HISTOGRAM_STEP) + 1, dtype=np.int64)
        self._squares = 0.0

    def numbers(self) -> np.ndarray:
        """Return the tally as numbers [n] float64, which `add_numbers` adds to another."""
        return np.array([self.fused, self.lost, self.refused, self._squares, *self._counts], dtype=np.float64)

    def add_numbers(self, numbers: np.ndarray) -> None:
        """Count the pixels of another tally of the same scan."""
        self.fused, self.lost, self.refused = (own + int(more) for own, more in zip((self.fused, self.lost, self.refused), numbers[:3],
                                                                                    strict=True))
        self._squares += float(numbers[3])
        self._counts += numbers[4:].astype(np.int64)

    def add(self, distance: np.ndarray, sigma: np.ndarray, fate: np.ndarray) -> None:
        """Count pixels: their distances from the surface and standard deviations, metres, and what became of them."""
        there = fate == FUSED
        self.fused += int(there.sum())
        self.lost += int((fate == LOST).sum())
        self.refused += int((fate == REFUSED).sum())
        bins = np.minimum(np.abs(distance[there]) / sigma[there] / HISTOGRAM_STEP, len(self._counts) - 1).astype(np.int64)
        self._counts += np.bincount(bins, minlength=len(self._counts))
        self._squares += float((distance[there].astype(np.float64) ** 2).sum())

    @property
    def pixels(self) -> int:
        """The number of pixels in cells."""
        return self.fused + self.lost + self.refused

    @property
    def rms_m(self) -> float:
        """The RMS distance of the pixels from the surface, metres."""
        return float(np.sqrt(self._squares / max(self.fused, 1)))

    @property
    def median_sigmas(self) -> float:
        """The median distance in standard deviations of a pixel."""
        return float((np.searchsorted(np.cumsum(self._counts), self.fused / 2) + 0.5) * HISTOGRAM_STEP)


class BrickSurface(NamedTuple):
    """The surface in one brick."""

    points: np.ndarray  # [V, 3] float64 metres, world
    normals: np.ndarray  # [V, 3] float32
    sigma: np.ndarray  # [V] float32 metres
    seen: np.ndarray  # [V] uint16
    photometric: np.ndarray  # [V] bool
    values: np.ndarray  # [V, C] float32
    edge: np.ndarray  # [V, 4] int32, the edge of the lattice on which each vertex lies
    faces: np.ndarray  # [F, 3] int32
    tallies: dict[int, np.ndarray]  # the numbers of the tally of each scan that can see the brick
    blocks: int


VERTEX = ("points", "normals", "sigma", "seen", "photometric", "values")
"""The arrays of a surface with one entry for each vertex."""


def origin_of(centres: np.ndarray, voxel: float) -> np.ndarray:
    """Return the world point [3] that the lattice counts from: a multiple of the voxel near the mean of points [n, 3] of all scans."""
    return np.asarray(np.round(centres.mean(axis=0) / voxel) * voxel)


def fuse_brick(brick: np.ndarray, watching: list[Watching], names: tuple[str, ...], voxel: float, origin: np.ndarray, *, device: str
               ) -> BrickSurface:
    """Fuse what lies in a brick.

    Args:
        brick: its place [3], in bricks from the origin.
        watching: the scans that can see `box_of` the brick.
        names: their layers.
        voxel: side of a voxel, metres.
        origin: of the lattice, [3] metres.
        device: where to compute.

    Convention:
        The surface lies at the mean of the measured distances weighted by the inverse of their variances.
    """
    corner = (int(brick[0]) * BRICK_VOXELS, int(brick[1]) * BRICK_VOXELS, int(brick[2]) * BRICK_VOXELS)
    views = upload_views([scan.image.cropped(*window) for _, scan, window in watching], origin, device=device)
    found = find_blocks(views, voxel, corner, device=device)
    volume = integrate(found, views)
    triangles = extract(volume)
    distance, fate = residuals(volume, views)
    tallies = {}
    for place, (number, scan, (top, bottom, left, right)) in enumerate(watching):
        tally, part = Tally(), slice(views.first_cell[place], views.first_cell[place + 1])
        box = slice(top, bottom - 1), slice(left, right - 1)
        tally.add(distance[part], np.asarray(scan.image.sigma[box])[np.asarray(scan.image.cell[box])], fate[part])
        tallies[number] = tally.numbers()
    width = channels(names)[names[-1]].stop + (names[-1] != NORMAL) - channels(names)[NORMAL].stop
    values, normals, seen = np.zeros((0, width), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.uint16)
    photometric = np.zeros(0, dtype=bool)
    if len(triangles.faces):
        values, normals, photometric, seen = _shown(triangles, watching, views, names, voxel, device)
    return BrickSurface(triangles.points.astype(np.float64) + origin, normals, triangles.sigma, seen, photometric, values, triangles.edge,
                        triangles.faces, tallies, found.count)


def box_of(brick: np.ndarray, voxel: float, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner [3], metres, of what the views of a brick must be asked for."""
    low = origin + np.asarray(brick) * (BRICK_VOXELS * voxel)
    return low - 4 * voxel, low + (BRICK_VOXELS + 12) * voxel


def joined_surface(bricks: Iterable[BrickSurface], scans: int) -> Surface:
    """Return the surfaces of bricks, in their order, as one; `scans` is the number of scans."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in (*VERTEX, "edge", "faces")}
    tallies = [Tally() for _ in range(scans)]
    count = blocks = total = 0
    for brick in bricks:
        for number, numbers in brick.tallies.items():
            tallies[number].add_numbers(numbers)
        blocks, total = blocks + brick.blocks, total + 1
        if not len(brick.faces) and count:
            continue
        for name in parts:
            parts[name].append(getattr(brick, name) if name != "faces" else brick.faces.astype(np.int64) + count)
        count += len(brick.points)
    kept, faces = _welded(np.concatenate(parts.pop("edge")), parts.pop("faces"))
    joined = {name: np.concatenate(parts.pop(name))[kept] for name in VERTEX}  # one after another, so that few exist twice
    return Surface(**joined, faces=faces, tallies=tallies, bricks=total, blocks=blocks)


def centre_of(scan: PreparedScan) -> np.ndarray:
    """Return the world point at the median depth on the optical axis of a scan, [3] metres."""
    used = corners_of(np.asarray(scan.image.cell))
    depth = float(np.median(np.asarray(scan.image.depth)[used])) if used.any() else 0.0
    return np.asarray(np.linalg.inv(scan.image.camera_from_world)[:3] @ [0.0, 0.0, -depth, 1.0])


def world_points(scan: PreparedScan) -> tuple[np.ndarray, np.ndarray]:
    """Return the world points of the pixels of cells, [n, 3] float64 metres, and their row-major places [n]."""
    used = np.flatnonzero(corners_of(np.asarray(scan.image.cell)))
    depth = np.asarray(scan.image.depth).ravel()[used].astype(np.float64)
    u, v = pixel_centres(scan.camera.width, scan.camera.height)
    row, col = np.divmod(used, scan.camera.width)
    x, y = scan.camera.plane_at(np.broadcast_to(u, (scan.camera.height, scan.camera.width))[row, col],
                                np.broadcast_to(v, (scan.camera.height, scan.camera.width))[row, col])
    if not scan.image.orthographic:
        x, y = x * depth, y * depth
    points = np.stack([x, y, -depth], axis=-1)
    world = np.linalg.inv(scan.image.camera_from_world)
    return points @ world[:3, :3].T + world[:3, 3], used


def bricks_of(scan: PreparedScan, origin: np.ndarray, voxel: float) -> np.ndarray:
    """Return the bricks [n, 3] that the measured surface of a scan comes near."""
    size = BRICK_VOXELS * voxel
    points, used = world_points(scan)
    if len(points) == 0:
        return np.zeros((0, 3), dtype=np.int64)
    sigma = float(np.asarray(scan.image.sigma).ravel()[used].max())
    depth = float(np.asarray(scan.image.depth).ravel()[used].max())
    reach = max(TRUNCATION_VOXELS * voxel, TRUNCATION_SIGMAS * sigma / LEAST_COSINE) + 2 * voxel + scan.image.pixel_m(depth)
    low, high = (np.floor((points - origin + side * reach) / size).astype(np.int64) for side in (-1, 1))
    beyond = int((high - low).max()) + 1
    base, count = low.min(axis=0), np.ptp(low, axis=0) + 1
    numbers = np.ravel_multi_index(tuple(np.concatenate([low - base, high - low], axis=1).T), (*count, *[beyond] * 3))
    ranges = np.stack(np.unravel_index(np.unique(numbers), (*count, *[beyond] * 3)), axis=1)  # few, so that each is looked at alone
    return np.unique(np.concatenate([base + (ranges[:, :3] + step)[(np.array(step) <= ranges[:, 3:]).all(axis=1)]
                                     for step in np.ndindex(*[beyond] * 3)]), axis=0)


def _window(scan: PreparedScan, low: np.ndarray, high: np.ndarray) -> tuple[int, int, int, int] | None:
    """Return the first and last rows and columns in which a box can lie, or None where the view cannot see it."""
    corners = np.array([[(low, high)[side][axis] for axis, side in enumerate(sides)] for sides in np.ndindex(2, 2, 2)])
    there = corners @ scan.image.camera_from_world[:3, :3].T + scan.image.camera_from_world[:3, 3]
    rows, cols = scan.image.depth.shape
    if not scan.image.orthographic:
        if (there[:, 2] >= 0).all():
            return None
        if (there[:, 2] > -1e-3 * np.abs(there).max()).any():
            return 0, rows, 0, cols
    u, v = scan.camera.image_coordinates(there)
    first_row, last_row = int(np.floor(v.min())) - WINDOW_PIXELS, int(np.ceil(v.max())) + WINDOW_PIXELS
    first_col, last_col = int(np.floor(u.min())) - WINDOW_PIXELS, int(np.ceil(u.max())) + WINDOW_PIXELS
    box = max(first_row, 0), min(last_row, rows), max(first_col, 0), min(last_col, cols)
    return box if box[1] - box[0] > 1 and box[3] - box[2] > 1 else None


def watching_views(scans: list[PreparedScan], low: np.ndarray, high: np.ndarray) -> list[Watching]:
    """Return the scans that can see a box of the world from its lowest to its highest corner, [3] metres."""
    found = ((number, scan, _window(scan, low, high)) for number, scan in enumerate(scans))
    return [Watching(number, scan, window) for number, scan, window in found if window is not None]


def upload_layers(watching: list[Watching], device: str) -> tuple[Any, Any]:
    """Return the layers and the feathers of windows of scans on the device, one after another."""
    layers, feathers = [], []
    for _, scan, (top, bottom, left, right) in watching:
        layers.append(np.asarray(scan.layers[top:bottom, left:right]).reshape(-1, scan.layers.shape[-1]))
        feathers.append(np.asarray(scan.feather[top:bottom, left:right]).reshape(-1, 1))
    return (wp.array(np.concatenate(layers), dtype=float, device=device), wp.array(np.concatenate(feathers), dtype=float, device=device))


def _shown(triangles: Any, watching: list[Watching], views: ViewArrays, names: tuple[str, ...],
           voxel: float, device: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the blended layers behind the normal of the vertices of a brick, their normals, whether these are photometric, and how many
    views see each."""
    with np.errstate(invalid="ignore"):  # faces of one vertex may cancel each other
        of_faces = np.nan_to_num(vertex_normals(triangles.points, NO_QUADS, triangles.faces))
    layers, feathers = upload_layers(watching, device)
    shown = gather(views, layers, feathers, *(wp.array(values, dtype=kind, device=device) for values, kind in (
        (triangles.points, wp.vec3), (of_faces, wp.vec3), (triangles.sigma, float))), vectors=3, slack=voxel, device=device)
    values = shown.values.numpy()
    place = channels(names)[NORMAL]
    normals = values[:, place]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1), of_faces).astype(np.float32)
    return values[:, place.stop:], normals, length[:, 0] > PHOTOMETRIC, shown.seen.numpy().astype(np.uint16)


def _welded(edge: np.ndarray, faces: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return which vertices are kept, [V] bool, and the faces with their numbers, [F, 3] int32: those of one edge of the lattice become
    one."""
    kept = np.ones(len(edge), dtype=bool)
    owner = np.arange(len(edge), dtype=np.int32)
    shared = np.flatnonzero((edge[:, :3] % BRICK_VOXELS == 0).any(axis=1))  # others lie inside of one brick
    if len(shared):
        low, size = edge[shared].min(axis=0), np.ptp(edge[shared], axis=0).astype(np.int64) + 1
        names = np.ravel_multi_index(tuple((edge[shared] - low).T), tuple(size))
        _, first, number = np.unique(names, return_index=True, return_inverse=True)
        kept[shared] = False
        kept[shared[first]] = True
        owner[shared] = shared[first][number.ravel()]
    renumbered = (np.cumsum(kept, dtype=np.int32) - 1)[owner]
    return kept, np.concatenate([renumbered[each] for each in faces])
