"""The surface of many range images, brick by brick, so that memory grows with the views that see one brick, not with the site.

The arrays of the scans lie in files that are mapped into memory. A brick is computed in boxes, each of which takes from each view the
window of pixels in which the box can lie. Boxes compute the lattice alike, so that their triangles share vertices where they meet. What the
views show at such a vertex is blended by the angle to the triangles around it, of which a box has its own alone: the first box that has the
vertex decides.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.fusion.bricks import BRICK_VOXELS, MARGIN_VOXELS, find_blocks
from kernels.fusion.extract import extract
from kernels.fusion.gather import gather
from kernels.fusion.integrate import integrate
from kernels.fusion.resample import STEEPEST, STEP_SIGMAS
from kernels.fusion.residuals import FUSED, LOST, REFUSED, residuals
from kernels.fusion.views import TRUNCATION_SIGMAS, TRUNCATION_VOXELS, ViewArrays, corners_of, upload_views
from service.asset.content.mesh import vertex_normals
from service.scans.fusion.boxes import LEAST_VOXELS, Box, Watching, boxes
from service.scans.fusion.closing import Closed
from service.scans.fusion.range_images import COLOUR, NORMAL, PreparedScan, channels
from stage.colour.colour import convert
from stage.results.mesh import TriangleMesh
from stage.transforms import pixel_centres

HISTOGRAM_STEP, HISTOGRAM_END = 0.05, 20.0
"""Width and end of the bins, in standard deviations, in which residuals are counted."""
PHOTOMETRIC = 0.5
"""Length of the blended normal from which on it is mostly photometric: normals fitted to depths count a hundredth in it."""
NO_QUADS = np.zeros((0, 4), dtype=np.int32)


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
    invented: np.ndarray | None = None  # [V] bool, vertices of membranes over holes; None: no hole was closed by one

    def closed_by(self, closed: Closed, *, invented: bool) -> "Surface":
        """Return the surface with what closes its holes; `invented`: nothing was measured there, and σ is not known."""
        before, further = len(self.points), closed.system.shape[0]
        points = closed.extended(self.points)
        normals = np.concatenate([self.normals, _normals_of_faces(points, closed.faces)[before:].astype(np.float32)])
        none = np.zeros(further, dtype=bool)
        sigma = np.concatenate([self.sigma, np.full(further, np.nan, np.float32)]) if invented else closed.extended(self.sigma)
        seen = np.concatenate([self.seen, none.astype(np.uint16)]) if invented else closed.extended(self.seen)
        return self._replace(points=points, normals=normals, sigma=sigma, seen=seen, values=closed.extended(self.values),
                             faces=np.concatenate([self.faces, closed.faces]),
                             photometric=np.concatenate([self.photometric, none]),
                             invented=np.arange(before + further) >= before if invented else None)


class Tally:
    """Counts of the pixels of one scan by their place relative to the fused surface."""

    def __init__(self) -> None:
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


def fuse_brick(places: np.ndarray, outlines: list[PreparedScan], scan: Callable[[int], PreparedScan], names: tuple[str, ...],
               voxel: float, origin: np.ndarray, *, device: str) -> BrickSurface:
    """Fuse what lies in a brick: the surface is the mean of the measured distances weighted by the inverse of their variances.

    Args:
        places: lattice coordinates [n, 3], in voxels, of the lowest voxels of the smallest boxes of the brick that surface comes near.
        outlines: of all scans, by which it is known which can see a box.
        scan: returns a scan by its place in `outlines`.
        names: the layers of the scans.
        origin: of the lattice, [3] metres.
    """
    def fused(box: Box) -> BrickSurface:
        watching = [each._replace(scan=scan(each.number)) for each in box.watching]
        found = _fuse_box(box, watching, names, voxel, origin, device)
        for each in watching:
            each.scan.release()
        return found

    return _welded(chain([_nothing(names)], map(fused, boxes(places, outlines, voxel, origin))), LEAST_VOXELS)


def _nothing(names: tuple[str, ...]) -> BrickSurface:
    """Return the surface of a brick in which there is none."""
    width = channels(names)[names[-1]].stop + (names[-1] != NORMAL) - channels(names)[NORMAL].stop
    return BrickSurface(np.zeros((0, 3)), np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.uint16), np.zeros(0, bool),
                        np.zeros((0, width), np.float32), np.zeros((0, 4), np.int32), np.zeros((0, 3), np.int32), {}, 0)


def _fuse_box(box: Box, watching: list[Watching], names: tuple[str, ...], voxel: float, origin: np.ndarray, device: str) -> BrickSurface:
    """Fuse what lies in a box, as the scans that can see it measured it."""
    views = upload_views([scan.image.cropped(*window) for _, scan, window in watching], origin, device=device)
    found = find_blocks(views, voxel, box.corner, box.blocks, device=device)
    volume = integrate(found, views)
    triangles = extract(volume)
    distance, fate = residuals(volume, views)
    tallies = {}
    for place, (number, scan, (top, bottom, left, right)) in enumerate(watching):
        tally, part = Tally(), slice(views.first_cell[place], views.first_cell[place + 1])
        inner = slice(top, bottom - 1), slice(left, right - 1)
        tally.add(distance[part], np.asarray(scan.image.sigma[inner])[np.asarray(scan.image.cell[inner])], fate[part])
        tallies[number] = tally.numbers()
    if not len(triangles.faces):
        return _nothing(names)._replace(tallies=tallies, blocks=found.count)
    values, normals, photometric, seen = _shown(triangles, watching, views, names, voxel, device)
    return BrickSurface(triangles.points.astype(np.float64) + origin, normals, triangles.sigma, seen, photometric, values, triangles.edge,
                        triangles.faces, tallies, found.count)


def joined_surface(bricks: Iterable[BrickSurface], scans: int) -> Surface:
    """Return the surfaces of bricks, in their order, as one; `scans` is the number of scans."""
    total = 0

    def counted() -> Iterator[BrickSurface]:
        nonlocal total
        for brick in bricks:
            total += 1
            yield brick

    joined = _welded(counted(), BRICK_VOXELS)
    tallies = [Tally() for _ in range(scans)]
    for number, numbers in joined.tallies.items():
        tallies[number].add_numbers(numbers)
    return Surface(**{name: getattr(joined, name) for name in VERTEX}, faces=joined.faces, tallies=tallies, bricks=total,
                   blocks=joined.blocks)


def triangle_mesh(surface: Surface | BrickSurface, names: tuple[str, ...]) -> TriangleMesh:
    """Return a surface as a mesh with the colours of its vertices, where any scan has some."""
    colours = None
    if COLOUR in names:
        first = channels(names)[COLOUR].start - 3  # behind the normal
        values, weight = surface.values[:, first:first + 3], surface.values[:, first + 3:first + 4]
        linear = np.where(weight > 0, values / np.where(weight > 0, weight, 1), 0).astype(np.float32)
        display = convert(linear[None], "lin_rec709_scene", "srgb_rec709_scene")[0] if len(linear) else linear
        colours = np.rint(np.clip(display, 0, 1) * 255).astype(np.uint8)
    return TriangleMesh(surface.points.astype(np.float32), surface.normals, surface.sigma, surface.seen, colours, surface.faces,
                        surface.invented if isinstance(surface, Surface) else None)


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


def places_near(scan: PreparedScan, origin: np.ndarray, voxel: float) -> np.ndarray:
    """Return the smallest boxes in which `find_blocks` may find blocks for a scan, as the lattice coordinates [n, 3] of their lowest
    voxels: those along the line of sight of each pixel, as far before and behind its surface as its own noise and a steep cell reach."""
    size, image = LEAST_VOXELS * voxel, scan.image
    points, used = world_points(scan)
    sigma, depth = (np.asarray(values).ravel()[used].astype(np.float64) for values in (image.sigma, image.depth))
    noise, pixel = np.minimum(sigma, depth), np.broadcast_to(image.pixel_m(depth), depth.shape)
    camera = np.linalg.inv(image.camera_from_world)
    sight = np.broadcast_to(-camera[:3, 2], points.shape) if image.orthographic else (points - camera[:3, 3]) / depth[:, None]
    reach = (TRUNCATION_SIGMAS + STEP_SIGMAS) * noise + TRUNCATION_VOXELS * voxel + STEEPEST * pixel
    order = np.argsort(-reach, kind="stable")
    points, sight, reach = points[order] - origin, sight[order], reach[order]
    margin = MARGIN_VOXELS * voxel + 2 * pixel[order, None] + size / 4  # steps of half a box lie a quarter of one from each place
    steps = np.ceil(reach / (size / 2)).astype(np.int64)
    found = [np.zeros((0, 3), dtype=np.int64)]
    for step in range(-steps.max(initial=0), steps.max(initial=-1) + 1):
        some = slice(np.searchsorted(-steps, -abs(step), side="right"))
        at = points[some] + np.clip(step * size / 2, -reach[some], reach[some])[:, None] * sight[some]
        found.append(_boxes_between(*(np.floor((at + side * margin[some]) / size).astype(np.int64) for side in (-1, 1))))
    return LEAST_VOXELS * np.unique(np.concatenate(found), axis=0)


def _boxes_between(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the boxes from lowest to highest ones, [n, 3] numbers each along the axes."""
    base, count, beyond = low.min(axis=0), np.ptp(low, axis=0) + 1, (high - low).max(axis=0) + 1
    numbers = np.ravel_multi_index(tuple(np.concatenate([low - base, high - low], axis=1).T), (*count, *beyond))
    ranges = np.stack(np.unravel_index(np.unique(numbers), (*count, *beyond)), axis=1)  # few, so that each is looked at alone
    return np.concatenate([base + (ranges[:, :3] + corner)[(np.array(corner) <= ranges[:, 3:]).all(axis=1)]
                           for corner in np.ndindex(*beyond)])


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
    of_faces = _normals_of_faces(triangles.points, triangles.faces)
    layers, feathers = upload_layers(watching, device)
    shown = gather(views, layers, feathers, *(wp.array(values, dtype=kind, device=device) for values, kind in (
        (triangles.points, wp.vec3), (of_faces, wp.vec3), (triangles.sigma, float))), vectors=3, slack=voxel, device=device)
    values = to_numpy(shown.values)
    place = channels(names)[NORMAL]
    normals = values[:, place]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1), of_faces).astype(np.float32)
    return values[:, place.stop:], normals, length[:, 0] > PHOTOMETRIC, to_numpy(shown.seen).astype(np.uint16)


def _normals_of_faces(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the mean normal [V, 3] of the faces around each vertex; 0 where these cancel each other."""
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(vertex_normals(points, NO_QUADS, faces))


def _welded(parts: Iterable[BrickSurface], side: int) -> BrickSurface:
    """Return surfaces, in their order, as one. Vertices of one edge of the lattice become one, that of the first part; it lies where the
    coordinates of the edge are multiples of `side`, in voxels: others lie inside of one part."""
    held: dict[str, list[np.ndarray]] = {name: [] for name in (*VERTEX, "edge", "faces")}
    tallies: dict[int, np.ndarray] = {}
    count = blocks = 0
    for part in parts:
        for number, numbers in part.tallies.items():
            tallies[number] = tallies[number] + numbers if number in tallies else numbers
        blocks += part.blocks
        if not len(part.faces) and held["faces"]:
            continue
        for name, arrays in held.items():
            arrays.append(getattr(part, name) if name != "faces" else part.faces.astype(np.int64) + count)
        count += len(part.points)
    edge = np.concatenate(held.pop("edge"))
    kept, renumbered = _shared_once(edge, side)
    faces = np.concatenate([renumbered[each] for each in held.pop("faces")])
    joined = {name: np.concatenate(held.pop(name))[kept] for name in VERTEX}  # one after another, so that few exist twice
    return BrickSurface(**joined, edge=edge[kept], faces=faces, tallies=tallies, blocks=blocks)


def _shared_once(edge: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which vertices of lattice edges [V, 4] are kept, [V] bool, and by which of the kept ones each is replaced, [V] int32."""
    kept = np.ones(len(edge), dtype=bool)
    owner = np.arange(len(edge), dtype=np.int32)
    shared = np.flatnonzero((edge[:, :3] % side == 0).any(axis=1))
    if len(shared):
        low, size = edge[shared].min(axis=0), np.ptp(edge[shared], axis=0).astype(np.int64) + 1
        names = np.ravel_multi_index(tuple((edge[shared] - low).T), tuple(size))
        _, first, number = np.unique(names, return_index=True, return_inverse=True)
        kept[shared] = False
        kept[shared[first]] = True
        owner[shared] = shared[first][number.ravel()]
    return kept, (np.cumsum(kept, dtype=np.int32) - 1)[owner]
