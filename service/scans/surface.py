"""The surface of many range images, brick by brick, so that memory is bounded whatever the size of the site.

The arrays of the scans lie in files that are mapped into memory. A brick takes from each view the window of pixels in which the brick can
lie; its triangles go to the mesh at once. Bricks compute the lattice alike, so that their triangles share vertices where they meet.
"""

from collections.abc import Callable
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


def fuse_surface(scans: list[PreparedScan], names: tuple[str, ...], voxel: float, *, device: str,
                 progress: Callable[[float], None] = lambda done: None) -> Surface:
    """Fuse scans.

    Args:
        scans: at least one.
        names: their layers.
        voxel: side of a voxel, metres.
        device: where to compute.
        progress: is called with the part that is done, 0…1.

    Convention:
        The surface lies at the mean of the measured distances weighted by the inverse of their variances.
    """
    size = BRICK_VOXELS * voxel
    middle = np.mean([np.linalg.inv(scan.image.camera_from_world)[:3] @ [*_centre(scan), 1.0] for scan in scans], axis=0)
    origin = np.round(middle / voxel) * voxel
    bricks = _bricks(scans, origin, voxel)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("points", "normals", "sigma", "seen", "values", "edge", "faces")}
    tallies = [Tally() for _ in scans]
    count = blocks = 0
    for done, brick in enumerate(bricks):
        progress(done / len(bricks))
        corner = (int(brick[0]) * BRICK_VOXELS, int(brick[1]) * BRICK_VOXELS, int(brick[2]) * BRICK_VOXELS)
        low = origin + np.array(corner) * voxel
        watching = watching_views(scans, low - 4 * voxel, low + size + 12 * voxel)
        views = upload_views([scan.image.cropped(*window) for _, scan, window in watching], origin, device=device)
        found = find_blocks(views, voxel, corner, device=device)
        volume = integrate(found, views)
        triangles = extract(volume)
        blocks += found.count
        distance, fate = residuals(volume, views)
        for place, (number, scan, (top, bottom, left, right)) in enumerate(watching):
            part = slice(views.first_cell[place], views.first_cell[place + 1])
            box = slice(top, bottom - 1), slice(left, right - 1)
            tallies[number].add(distance[part], np.asarray(scan.image.sigma[box])[np.asarray(scan.image.cell[box])], fate[part])
        if len(triangles.faces) == 0:
            continue
        values, normals, seen = _shown(triangles, watching, views, names, voxel, device)
        for name, given in (("points", triangles.points.astype(np.float64) + origin), ("normals", normals), ("sigma", triangles.sigma),
                            ("seen", seen), ("values", values), ("edge", triangles.edge),
                            ("faces", triangles.faces.astype(np.int64) + count)):
            parts[name].append(given)
        count += len(triangles.points)
    if not count:
        empty = [np.zeros((0, width), dtype=np.float32) for width in (3, 3, 0)]
        return Surface(empty[0].astype(np.float64), empty[1], np.zeros(0, np.float32), np.zeros(0, np.uint16), empty[2],
                       np.zeros((0, 3), np.int32), tallies, len(bricks), blocks)
    joined = {name: np.concatenate(given) for name, given in parts.items()}
    kept, faces = _welded(joined.pop("edge"), joined.pop("faces"))
    return Surface(**{name: given[kept] for name, given in joined.items()}, faces=faces, tallies=tallies, bricks=len(bricks), blocks=blocks)


def _centre(scan: PreparedScan) -> np.ndarray:
    """Return the camera-frame point at the median depth on the optical axis, [3]."""
    used = corners_of(np.asarray(scan.image.cell))
    return np.array([0.0, 0.0, -float(np.median(np.asarray(scan.image.depth)[used])) if used.any() else 0.0])


def world_points(scan: PreparedScan) -> tuple[np.ndarray, np.ndarray]:
    """Return the world points of the pixels of cells, [n, 3] float64 metres, and their row-major places [n]."""
    used = np.flatnonzero(corners_of(np.asarray(scan.image.cell)))
    depth = np.asarray(scan.image.depth).ravel()[used].astype(np.float64)
    u, v = pixel_centres(scan.camera.width, scan.camera.height)
    row, col = np.divmod(used, scan.camera.width)
    x, y = scan.camera.plane_at(np.broadcast_to(u, (scan.camera.height, scan.camera.width))[row, col],
                                np.broadcast_to(v, (scan.camera.height, scan.camera.width))[row, col])
    points = np.stack([x * depth, y * depth, -depth], axis=-1)
    world = np.linalg.inv(scan.image.camera_from_world)
    return points @ world[:3, :3].T + world[:3, 3], used


def _bricks(scans: list[PreparedScan], origin: np.ndarray, voxel: float) -> np.ndarray:
    """Return the bricks [n, 3] that measured surface comes near."""
    size = BRICK_VOXELS * voxel
    found = []
    for scan in scans:
        points, used = world_points(scan)
        if len(points) == 0:
            continue
        sigma = float(np.asarray(scan.image.sigma).ravel()[used].max())
        depth = float(np.asarray(scan.image.depth).ravel()[used].max())
        reach = max(TRUNCATION_VOXELS * voxel, TRUNCATION_SIGMAS * sigma / LEAST_COSINE) + 2 * voxel + depth / min(scan.image.focal)
        low, high = (np.floor((points - origin + side * reach) / size).astype(np.int64) for side in (-1, 1))
        beyond = int((high - low).max()) + 1
        base, count = low.min(axis=0), np.ptp(low, axis=0) + 1
        numbers = np.ravel_multi_index(tuple(np.concatenate([low - base, high - low], axis=1).T), (*count, *[beyond] * 3))
        ranges = np.stack(np.unravel_index(np.unique(numbers), (*count, *[beyond] * 3)), axis=1)  # few, so that each is looked at alone
        for step in np.ndindex(*[beyond] * 3):
            found.append(base + (ranges[:, :3] + step)[(np.array(step) <= ranges[:, 3:]).all(axis=1)])
    return np.unique(np.concatenate(found), axis=0) if found else np.zeros((0, 3), dtype=np.int64)


def _window(scan: PreparedScan, low: np.ndarray, high: np.ndarray) -> tuple[int, int, int, int] | None:
    """Return the first and last rows and columns in which a box can lie, or None where the view cannot see it."""
    corners = np.array([[(low, high)[side][axis] for axis, side in enumerate(sides)] for sides in np.ndindex(2, 2, 2)])
    there = corners @ scan.image.camera_from_world[:3, :3].T + scan.image.camera_from_world[:3, 3]
    rows, cols = scan.image.depth.shape
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
           voxel: float, device: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the blended layers behind the normal, the normals, and how many views see each vertex of a brick."""
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
    return values[:, place.stop:], normals, shown.seen.numpy().astype(np.uint16)


def _welded(edge: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices that are kept, [n] int64, and the faces with their numbers: those of one edge of the lattice become one."""
    shared = np.flatnonzero((edge[:, :3] % BRICK_VOXELS == 0).any(axis=1))  # others lie inside of one brick
    if len(shared) == 0:
        return np.arange(len(edge)), faces.astype(np.int32)
    low = edge[shared].min(axis=0)
    names = np.ravel_multi_index(tuple((edge[shared] - low).T.astype(np.int64)), tuple(np.ptp(edge[shared], axis=0).astype(np.int64) + 1))
    _, first, number = np.unique(names, return_index=True, return_inverse=True)
    owner = np.arange(len(edge))
    owner[shared] = shared[first][number.ravel()]
    kept = np.flatnonzero(owner == np.arange(len(edge)))
    renumbered = np.zeros(len(edge), dtype=np.int64)
    renumbered[kept] = np.arange(len(kept))
    return kept, renumbered[owner[faces]].astype(np.int32)


