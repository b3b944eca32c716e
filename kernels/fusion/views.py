"""Range images on the device, and what they measured on the line of sight through a point in space.

The depth between four pixels is bilinear in inverse depth, or in depth under an orthographic camera: exact on planes. Nothing is read
between pixels that show two surfaces, one behind the other: only cells of four pixels that are marked as one surface count.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.fusion.projection import View, depth_of, line_of_sight, linear_of

TILE = 4
"""Side in pixels of the squares whose farthest depth tells whether a block of voxels is hidden from a view."""
LATERAL = 0.1
"""Standard deviation of the place of a reading across the line of sight, in pixels, as calibrations and optics leave it. Seen at a grazing
angle it is what limits a measurement, whatever the standard deviation of the depth."""
BEND = 0.3
"""Standard deviation of the distance of a reading, in pixels, times the bend of the surface between its four pixels, which is 0.7 where two
of them face at a right angle to the others: what lies between pixels is not known, and edges are rounded."""
SPACING = 0.29
"""Standard deviation in pixels that the weights of readings use in its place: that of a uniform distribution over a pixel, 1/√12. The chord
between pixels cuts a bent surface short, more so at grazing angles; that error does not average out."""
WIDER = 1.3
"""Factor by which distortion is taken to lengthen lines of sight, where only their greatest length matters."""
LEAST_NORMAL = 2.0
"""Least length of the sum of the normals of the four pixels of a cell: shorter, they show no one surface."""
LEAST_COSINE = 0.2
"""Smallest cosine between the normal and the line of sight at which a reading counts: 78°."""

ALONG = 1.5
"""Farthest that a voxel may lie behind the measured point on the line of sight, in truncations: a distance from a plane says nothing
far beside the point where it was measured, as behind an edge."""
TRUNCATION_VOXELS = 3.0
"""Least distance from a measured surface, in voxels, over which its distances are kept: two on each side of a surface are needed, and one
for what views differ by."""
TRUNCATION_SIGMAS = 4.0
"""Least such distance in standard deviations of the measurement: within it the noise cuts off nothing that would bias the mean."""


class RangeImage(NamedTuple):
    """One range image of a camera that looks along −z, with +x to the right and +y up, and where it stands."""

    depth: np.ndarray  # [rows, cols] metres, −z of the camera frame, above 0; read inside cells alone
    sigma: np.ndarray  # [rows, cols] metres, standard deviation of the depth, above 0 inside cells
    normal: np.ndarray  # [rows, cols, 3] unit, camera frame, towards the camera; 0 where unknown
    cell: np.ndarray  # [rows, cols] bool, whether the pixel, its right and its lower neighbours and the one across show one surface
    clear: np.ndarray  # [rows, cols] metres: what is nearer than this was seen to be empty; 0 where nothing is known
    camera_from_world: np.ndarray  # [4, 4] rotation and translation, metres
    focal: tuple[float, float]  # pixels; of an orthographic camera pixels for each metre
    principal: tuple[float, float]  # u and v, pixels from the top-left corner
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1, k2, k3, p1, p2 of OpenCV
    first_row: int = 0  # of the arrays in the image that `principal` is of
    first_col: int = 0
    orthographic: bool = False
    """True if the lines of sight are parallel; the frame then lies before everything that was measured, so that depths are above 0."""

    def pixel_m(self, depth: float) -> float:
        """Return the distance of neighbouring pixels at a depth, both in metres."""
        return (1.0 if self.orthographic else depth) / min(self.focal)

    def cropped(self, first_row: int, last_row: int, first_col: int, last_col: int) -> "RangeImage":
        """Return the part of the image from the first row and column to those before the last."""
        box = slice(first_row, last_row), slice(first_col, last_col)
        return self._replace(depth=self.depth[box], sigma=self.sigma[box], normal=self.normal[box], cell=self.cell[box],
                             clear=self.clear[box], first_row=self.first_row + first_row, first_col=self.first_col + first_col)


@wp.struct
class Cell:
    """Four neighbouring pixels of one range image that show one surface, and how sure a reading between them is."""

    view: int
    place: int  # of the upper left pixel in the arrays of all pixels
    linear: wp.vec4  # `linear_of` the depth of the upper left, upper right, lower left and lower right pixel
    normal: wp.vec3  # unit, camera frame, mean of the four
    weight: float  # 1 / square metres, inverse square of `sigma`; 0 where nothing can be read
    sigma: float  # metres, standard deviation along the normal of the reading of one pixel, as readings are weighted
    along: float  # square metres, variance along the normal that the depth of one pixel has
    lateral: float  # square metres, variance along the normal that the place across the line of sight and the bend between pixels have
    largest: float  # metres, largest standard deviation along the line of sight


@wp.struct
class Measured:
    """The measurements of all views, as kernels read them; the fields are those of `ViewArrays`."""

    views: wp.array(dtype=View)
    cell: wp.array(dtype=int)
    cells: wp.array(dtype=Cell)
    clear: wp.array(dtype=float)


class ViewArrays(NamedTuple):
    """The range images of several views, one after another, on the device."""

    views: Any  # wp.array [V] of View
    cell: Any  # wp.array [P] int32, the number of the cell whose upper left pixel each is, −1 where there is none
    cells: Any  # wp.array [C] of Cell, in the order of their pixels
    clear: Any  # wp.array [P] metres
    farthest: Any  # wp.array [T] metres, depth behind which each tile says nothing, but for the truncation in voxels; 0: nothing at all
    count: int  # views
    pixels: int
    shapes: tuple[tuple[int, int], ...]
    first: tuple[int, ...]
    first_cell: tuple[int, ...]  # of each view, and the number of all cells

    def measured(self) -> Any:
        """Return the `Measured` of these views."""
        measured = Measured()
        measured.views, measured.cell, measured.cells, measured.clear = self.views, self.cell, self.cells, self.clear
        return measured


def upload_views(images: Sequence[RangeImage], origin: np.ndarray, *, device: str) -> ViewArrays:
    """Copy range images to a device.

    Args:
        origin: [3] world point, metres, that coordinates on the device count from: near the middle of the scene, so that they are short in
            single precision, and one for all bricks, whose values are the same to the last bit only then.
    """
    structs, planes = [], {name: [] for name in ("depth", "sigma", "normal", "clear", "farthest", "place", "owner")}
    first = first_tile = 0
    starts, shapes, first_cells = [], [], [0]
    for number, image in enumerate(images):
        rows, cols = image.depth.shape
        for name in ("sigma", "cell", "clear", "normal"):
            if getattr(image, name).shape[:2] != (rows, cols):
                raise ArrayError(f"{name} of view {number} has shape {getattr(image, name).shape}, its depth {image.depth.shape}: give one "
                                 "value per pixel")
        used = corners_of(image.cell)
        with np.errstate(invalid="ignore"):
            if not (image.depth[used] > 0).all() or not (image.sigma[used] > 0).all():
                raise ArrayError(f"view {number} has a depth or a standard deviation in a cell that is not above 0")
        view = View()
        view.first, view.first_tile, view.rows, view.cols = first, first_tile, rows, cols
        view.first_row, view.first_col = image.first_row, image.first_col
        rotation = np.asarray(image.camera_from_world, dtype=np.float64)[:3, :3]
        shift = rotation @ np.asarray(origin, dtype=np.float64) + np.asarray(image.camera_from_world, dtype=np.float64)[:3, 3]
        view.orthographic = image.orthographic
        view.rotation = wp.mat33(*(float(v) for v in rotation.ravel()))
        view.translation = wp.vec3(*(float(v) for v in shift))
        view.focal, view.principal = wp.vec2(*map(float, image.focal)), wp.vec2(*map(float, image.principal))
        view.radial, view.tangential = wp.vec3(*map(float, image.distortion[:3])), wp.vec2(*map(float, image.distortion[3:]))
        view.distorted = any(image.distortion)
        structs.append(view)
        row, col = np.nonzero(image.cell[:-1, :-1])  # the neighbours of the last row and column are not here
        for name in ("depth", "sigma", "normal", "clear"):
            planes[name].append(np.asarray(getattr(image, name), dtype=np.float32).reshape(rows * cols, -1))
        planes["place"].append((first + row * cols + col).astype(np.int32))
        planes["owner"].append(np.full(len(row), number, dtype=np.int32))
        tiles = _farthest(np.maximum(np.where(used, image.depth + _behind(image), 0), image.clear))
        planes["farthest"].append(tiles.ravel())
        starts.append(first)
        shapes.append((rows, cols))
        first_cells.append(first_cells[-1] + len(row))
        first += rows * cols
        first_tile += tiles.size
    held = {name: wp.array(np.concatenate(planes[name]).reshape(-1, 3) if dtype is wp.vec3 else np.concatenate(planes[name]).ravel(),
                           dtype=dtype, device=device)
            for name, dtype in (("depth", float), ("sigma", float), ("normal", wp.vec3), ("clear", float), ("farthest", float),
                                ("place", int), ("owner", int))}
    views = wp.array(structs, dtype=View, device=device)
    cell = wp.full(first, -1, dtype=int, device=device)
    cells = wp.empty(first_cells[-1], dtype=Cell, device=device)
    devices.launch(_cell_kernel, first_cells[-1], [views, held["place"], held["owner"], held["depth"], held["sigma"], held["normal"]],
                   [cell, cells], device=device)
    return ViewArrays(views, cell, cells, held["clear"], held["farthest"], len(structs), first, tuple(shapes), tuple(starts),
                      tuple(first_cells))


def _behind(image: RangeImage) -> np.ndarray:
    """Return [rows, cols] metres, at least how far behind its depth a pixel says anything, but for the truncation in voxels."""
    rows, cols = image.depth.shape
    if image.orthographic:
        return ALONG * TRUNCATION_SIGMAS * (image.sigma + SPACING * image.pixel_m(0.0))
    x, y = ((np.array([first, first + count]) - middle) / focal for first, count, middle, focal in (
        (image.first_col, cols, image.principal[0], image.focal[0]), (image.first_row, rows, image.principal[1], image.focal[1])))
    stretch = WIDER * float(np.sqrt(1 + np.abs(x).max() ** 2 + np.abs(y).max() ** 2))
    return ALONG * TRUNCATION_SIGMAS * (stretch * image.sigma + SPACING * image.depth / min(image.focal))


def corners_of(cell: np.ndarray) -> np.ndarray:
    """Return [rows, cols] bool, the pixels that are a corner of a cell; cells of the last row and column do not exist."""
    inner = cell[:-1, :-1]
    used = np.zeros(cell.shape, dtype=bool)
    for down in (0, 1):
        for right in (0, 1):
            used[down:cell.shape[0] - 1 + down, right:cell.shape[1] - 1 + right] |= inner
    return used


def _farthest(depth: np.ndarray) -> np.ndarray:
    """Return the largest value of each tile."""
    rows, cols = (-(-side // TILE) for side in depth.shape)
    padded = np.zeros((rows * TILE, cols * TILE), dtype=np.float32)
    padded[:depth.shape[0], :depth.shape[1]] = depth
    return padded.reshape(rows, TILE, cols, TILE).max(axis=(1, 3))


@wp.func
def truncation(sigma: float, voxel: float) -> float:
    """Return the distance from a surface, in metres, over which its distances are kept."""
    return wp.max(TRUNCATION_VOXELS * voxel, TRUNCATION_SIGMAS * sigma)


@wp.kernel(enable_backward=False)
def _cell_kernel(first: int, views: wp.array(dtype=View), place: wp.array(dtype=int), owner: wp.array(dtype=int),
                 depth: wp.array(dtype=float), sigma: wp.array(dtype=float), normal: wp.array(dtype=wp.vec3),
                 # outputs
                 number: wp.array(dtype=int), cells: wp.array(dtype=Cell)):
    i = first + wp.tid()
    upper = place[i]
    view = views[owner[i]]
    lower = upper + view.cols
    row = (upper - view.first) // view.cols
    col = upper - view.first - row * view.cols
    found = Cell()
    found.view = owner[i]
    found.place = upper
    found.linear = wp.vec4(linear_of(view, depth[upper]), linear_of(view, depth[upper + 1]), linear_of(view, depth[lower]),
                           linear_of(view, depth[lower + 1]))
    ray = line_of_sight(view, float(col + view.first_col) + 1.0, float(row + view.first_row) + 1.0)
    length = wp.length(ray)
    found.largest = length * wp.max(wp.max(sigma[upper], sigma[upper + 1]), wp.max(sigma[lower], sigma[lower + 1]))
    n = normal[upper] + normal[upper + 1] + normal[lower] + normal[lower + 1]
    shared = wp.length(n)
    found.weight = 0.0
    if shared >= LEAST_NORMAL:
        n = n / shared
        toward = -wp.dot(n, ray)
        cosine = toward / length
        if cosine >= LEAST_COSINE:
            one = 0.25 * (sigma[upper] + sigma[upper + 1] + sigma[lower] + sigma[lower + 1])
            middle = 0.25 * (found.linear[0] + found.linear[1] + found.linear[2] + found.linear[3])
            pixel = 1.0 / (wp.where(view.orthographic, 1.0, middle) * wp.min(view.focal[0], view.focal[1]))
            across = pixel * pixel * (1.0 - cosine * cosine)
            found.normal = n
            found.along = one * one * toward * toward
            found.lateral = LATERAL * LATERAL * across + BEND * BEND * pixel * pixel * (1.0 - shared * shared / 16.0)
            found.weight = 1.0 / (found.along + SPACING * SPACING * across)
            found.sigma = wp.sqrt(found.along + SPACING * SPACING * across)
    cells[i] = found
    number[upper] = i


@wp.struct
class Reading:
    """The measurement of a view on the line of sight through a point."""

    known: bool
    distance: float  # metres from the measured surface along its normal, positive in front of it
    along: float  # metres from the measured surface along −z of the camera, positive in front of it
    sigma: float  # metres, standard deviation of the distance of one pixel, by which it is weighted
    weight: float  # 1 / square metres, inverse square of sigma
    variance: float  # square metres, that of the distance, which up to four pixels share
    normal: wp.vec3  # camera frame


@wp.func
def cell_at(view: View, at: wp.vec2, cell: wp.array(dtype=int)) -> int:
    """Return the number of the cell on which a point of the image of a view lies, −1 where there is none."""
    col = int(wp.floor(at[0] - 0.5)) - view.first_col
    row = int(wp.floor(at[1] - 0.5)) - view.first_row
    if col < 0 or row < 0 or col >= view.cols - 1 or row >= view.rows - 1:
        return -1
    return cell[view.first + row * view.cols + col]


@wp.func
def read_view(view: View, point: wp.vec3, at: wp.vec2, measured: Measured) -> Reading:
    """Return what a view measured on the line of sight through a camera-frame point that falls on `at` of its image."""
    found = Reading()
    found.known = False
    i = cell_at(view, at, measured.cell)
    if i < 0:
        return found
    found.weight = measured.cells[i].weight
    if found.weight == 0.0:
        return found
    fu = at[0] - 0.5 - wp.floor(at[0] - 0.5)
    fv = at[1] - 0.5 - wp.floor(at[1] - 0.5)
    four = measured.cells[i].linear
    upper = four[0] + fu * (four[1] - four[0])
    lower = four[2] + fu * (four[3] - four[2])
    found.along = depth_of(view, upper + fv * (lower - upper)) + point[2]
    found.normal = measured.cells[i].normal
    if view.orthographic:
        found.distance = found.along * found.normal[2]
    else:
        found.distance = found.along * wp.dot(found.normal, point) / point[2]
    found.sigma = measured.cells[i].sigma
    share = (1.0 - 2.0 * fu * (1.0 - fu)) * (1.0 - 2.0 * fv * (1.0 - fv))  # sum of the squares of the weights of the four pixels
    found.variance = share * measured.cells[i].along + measured.cells[i].lateral
    found.known = True
    return found
