"""A solved height map as a polygon mesh: arrays only, no file format.

One vertex per masked pixel (or every `step`-th one), four-sided faces between neighbours that lie on one surface
(service/asset/content/links.py). No face leads across a gap or a break: nothing was seen of what lies between. There the surface goes on
for half a pixel, to the edge of its outermost pixels, so that seen by the camera the mesh covers its pixels and nothing else, and both
sides of a break meet.

The faces are marching squares over links. A cell lies between four neighbouring pixels. Its corners that are linked along its sides lie on
one surface and get one patch of faces, which ends half-way to the corners of other surfaces. Every side of a patch that does not lie on the
border belongs to the patches of two neighbouring cells, and around each pixel four patches meet: without a step no vertex has more than one
fan of faces.

Source: Lorensen and Cline, "Marching cubes", SIGGRAPH 1987, in two dimensions and with links in place of a threshold.
"""

import math
from typing import NamedTuple

import numpy as np

from service.asset.content.links import Links, drawn_apart, height_of, relief, split_fans, surface_links, touched, without_islands
from service.errors import SurfaceError
from stage.results.depth_breaks import STEEPEST
from stage.results.maps import SurfaceMaps

VERTEX_BUDGET = 1_000_000
"""Vertices above which pixels are skipped: what DCC viewports and the web viewer still turn smoothly (some 60 MB)."""
CORNERS = 4
"""A cell of the pixel grid, counter-clockwise seen by the viewer: top left, bottom left, bottom right, top right."""
RIGHT, UP, LEFT, DOWN = range(4)
_ROW_STEP, _COL_STEP = np.array([0, -1, 0, 1]), np.array([1, 0, -1, 0])
_TO_NEXT, _TO_LAST = (DOWN, RIGHT, UP, LEFT), (RIGHT, UP, LEFT, DOWN)
"""Direction from each corner to the next one of the cell, and to the one before it."""
BORDER_PX = 0.499
"""Distance in pixels from the centre of a pixel to the border of the mesh: to the edge of the pixel, and still inside of its texel."""
_CENTRE_OF_CELL = 5
"""Kind of a vertex: 0 on a pixel, 1 to 4 on the border in one of the directions, 5 in the middle of a cell, where a break ends."""


class SurfaceMesh(NamedTuple):
    """A mesh in the camera frame, wound counter-clockwise as the camera sees it; edges have at most two faces, vertices one fan."""

    points: np.ndarray  # [V, 3] float32, camera frame, unit of the height map
    normals: np.ndarray  # [V, 3] float32, unit, area-weighted mean of the adjacent faces
    st: np.ndarray  # [V, 2] float32, texture coordinates, (0, 0) at the lower left corner of the image
    quads: np.ndarray  # [Q, 4] int32, vertex numbers
    triangles: np.ndarray  # [T, 3] int32, vertex numbers
    rows: np.ndarray  # [V] int64, row of the pixel in which each vertex lies or on whose edge it lies
    cols: np.ndarray  # [V] int64, its column
    step: int  # every step-th pixel in both directions carries a vertex
    centred: int  # so many of the first vertices lie on the centre of their pixel, the others along the border

    @property
    def face_counts(self) -> np.ndarray:
        """Corners per face, [Q + T] int32: quads first."""
        return np.repeat(np.array([4, 3], dtype=np.int32), [len(self.quads), len(self.triangles)])

    @property
    def face_indices(self) -> np.ndarray:
        """Vertex numbers of the corners of each face, [4 Q + 3 T] int32."""
        return np.concatenate([self.quads.ravel(), self.triangles.ravel()])

    @property
    def extent(self) -> np.ndarray:
        """Lowest and highest corner of the bounding box, [2, 3] float32."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])


def height_mesh(maps: SurfaceMaps, *, vertex_budget: int = VERTEX_BUDGET, links: Links | None = None) -> SurfaceMesh:
    """Return a height map as a mesh.
    `maps`: with `height`; pixels outside the mask, not finite, or not in front of a perspective camera get no vertex, nor do single pixels,
    lines that are one pixel wide, and islands of a few pixels. `vertex_budget`: above it only every k-th pixel in both directions is used,
    with the smallest k that fits. `links`: which neighbours lie on one surface; None: those of surface_links.

    Convention:
        st = ((c + 0.5) / W, 1 - (r + 0.5) / H) for the pixel (row r, column c), so that a vertex lies on the centre
        of its own texel.
    """
    valid = valid_heights(maps)
    assert maps.height is not None
    if not _three_neighbours(valid):
        raise SurfaceError(f"the mask holds {np.count_nonzero(valid)} pixels with a height and no three of them are neighbours, so there "
                           "is no face to export")
    links = without_islands(surface_links(maps, valid) if links is None else links)
    step = _step(touched(links), vertex_budget)
    faces = cell_faces(links, step)
    if len(faces.quads) + len(faces.triangles) == 0:
        raise SurfaceError("no neighbouring pixels lie on one surface, so there is no face to export; --geometry points "
                           "exports those of a depth")
    camera, (rows, cols) = maps.camera, faces.pixel.T
    nearest, other = (relief(maps.height[tuple(pixel.T)].astype(np.float64), camera) for pixel in (faces.pixel, faces.other))
    slope = np.where(faces.weight > 0, np.clip(nearest - other, -STEEPEST, STEEPEST), nearest - other)
    height = np.where(faces.weight == 0, maps.height[rows, cols], height_of(nearest + faces.weight * slope, camera))
    v, u = (faces.pixel + faces.shift + 0.5).T
    points = camera.points_over(u, v, height)
    st = np.stack([u / camera.width, 1 - v / camera.height], axis=-1).astype(np.float32)
    normals = vertex_normals(points, faces.quads, faces.triangles)
    return SurfaceMesh(points, normals, st, faces.quads, faces.triangles, rows, cols, step, faces.centred)


def valid_heights(maps: SurfaceMaps) -> np.ndarray:
    """Return where the maps have a height in front of the camera: [rows, cols] bool."""
    if maps.height is None:
        raise SurfaceError("the maps have no height layer, so there is no surface to export: solve with a height")
    valid = maps.mask & np.isfinite(maps.height)
    if maps.camera.projection == "perspective":
        valid &= maps.height < 0
    return valid


def face_to_vertex(quad_values: np.ndarray, triangle_values: np.ndarray, quads: np.ndarray, triangles: np.ndarray,
                   vertex_count: int) -> np.ndarray:
    """Sum a vector for each face, [Q, 3] and [T, 3], onto the face's corners, and return the normalised sums [V, 3] float64."""
    corners = np.concatenate([quads.ravel(), triangles.ravel()])
    values = np.concatenate([np.repeat(quad_values, 4, axis=0), np.repeat(triangle_values, 3, axis=0)])
    total = np.stack([np.bincount(corners, values[:, axis], minlength=vertex_count) for axis in range(3)], axis=-1)
    return total / np.linalg.norm(total, axis=-1, keepdims=True)


def vertex_normals(points: np.ndarray, quads: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return vertex normals [V, 3] float32: the normalised sums of the area vectors of the adjacent faces."""
    p = points.astype(np.float64)
    quad_area = np.cross(p[quads[:, 2]] - p[quads[:, 0]], p[quads[:, 3]] - p[quads[:, 1]])
    triangle_area = np.cross(p[triangles[:, 1]] - p[triangles[:, 0]], p[triangles[:, 2]] - p[triangles[:, 0]])
    return face_to_vertex(quad_area, triangle_area, quads, triangles, len(points)).astype(np.float32)


def _step(pixels: np.ndarray, vertex_budget: int) -> int:
    """Return the smallest step whose vertices fit the budget."""
    step = max(1, math.isqrt(np.count_nonzero(pixels) // vertex_budget))
    while np.count_nonzero(pixels[::step, ::step]) > vertex_budget:
        step += 1
    return step


def _three_neighbours(valid: np.ndarray) -> bool:
    """Return whether three pixels of any 2×2 pixels are valid."""
    count = valid[:-1, :-1].astype(np.uint8) + valid[1:, :-1] + valid[1:, 1:] + valid[:-1, 1:]
    return bool((count >= CORNERS - 1).any())


class CellFaces(NamedTuple):
    """Faces, and where their vertices lie: relief = that of the pixel + weight · (that of the pixel − that of the other pixel)."""

    quads: np.ndarray  # [Q, 4] int32, vertex numbers, counter-clockwise seen by the viewer
    triangles: np.ndarray  # [T, 3] int32
    pixel: np.ndarray  # [V, 2] int64, row and column
    other: np.ndarray  # [V, 2] int64, a pixel of the same surface
    weight: np.ndarray  # [V] float64
    shift: np.ndarray  # [V, 2] float64, pixels downwards and to the right from the centre of the pixel
    centred: int  # so many of the first vertices lie on the centres of their pixels


class _Grid(NamedTuple):
    """Every step-th pixel in both directions, with a ring of absent pixels around."""

    step: int
    present: np.ndarray  # [rows, cols] bool
    reach: np.ndarray  # [4, rows, cols], links in a row from the pixel in each direction, at most step
    right: np.ndarray  # [rows, cols] bool: linked to the next pixel of the grid on the right
    down: np.ndarray  # [rows, cols] bool
    whole: np.ndarray  # [rows - 1, cols - 1] bool: the pixels between four pixels of the grid are linked throughout

    def sides(self) -> np.ndarray:
        """Return whether each corner of each cell is linked to the next one: [4, rows - 1, cols - 1] bool."""
        return np.stack([self.down[:-1, :-1], self.right[1:, :-1], self.down[:-1, 1:], self.right[:-1, :-1]])


def cell_faces(links: Links, step: int = 1) -> CellFaces:
    """Return the faces between every step-th pixel, and their vertices.

    Pixels that no cell links to two others, on which single pixels and lines of one pixel's width consist, get no vertex.
    With a step, the border is followed to within a step, and cells around a hole or a break that lies between the pixels of the grid are
    left out.
    """
    grid = _without_lines(_grid(links, step))
    cols = grid.present.shape[1]
    count = grid.present.size
    sides = grid.sides()
    number = np.arange(count, dtype=np.int32).reshape(grid.present.shape)
    corners = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]])
    full = sides.all(axis=0)
    quads, triangles = [corners[:, full & grid.whole].T], [np.zeros((0, 3), dtype=np.int32)]

    at_border = ~full & (grid.present[:-1, :-1] | grid.present[1:, :-1] | grid.present[1:, 1:] | grid.present[:-1, 1:])
    corner, linked = corners[:, at_border], sides[:, at_border]
    present = grid.present.reshape(-1)[corner]
    for first in range(CORNERS):
        begins = present[first] & ~linked[first - 1]
        for length in range(1, CORNERS + 1):
            last = (first + length - 1) % CORNERS
            chosen = begins & ~linked[last]
            for side in range(first, first + length - 1):
                chosen = chosen & linked[side % CORNERS]
            a = [corner[(first + place) % CORNERS, chosen] for place in range(length)]
            ahead, behind = count * (1 + _TO_NEXT[last]) + a[-1], count * (1 + _TO_LAST[first]) + a[0]
            if length == 1:
                triangles.append(np.stack([a[0], ahead, behind], axis=-1))
            elif length == CORNERS:
                middle = count * _CENTRE_OF_CELL + corner[0, chosen]
                ring = [*a, ahead]
                triangles += [np.stack([one, two, middle], axis=-1) for one, two in zip([behind, *a], ring, strict=True)]
            else:
                quads.append(np.stack([a[0], a[-1], ahead, behind], axis=-1))
                if length == CORNERS - 1:
                    triangles.append(np.stack(a, axis=-1))
    return _with_vertices(np.concatenate(quads), np.concatenate(triangles), grid, count, cols)


def _with_vertices(quads: np.ndarray, triangles: np.ndarray, grid: _Grid, count: int, cols: int) -> CellFaces:
    """Return the faces with vertices numbered anew, those on pixels first, and the places of the vertices."""
    used = np.zeros((_CENTRE_OF_CELL + 1) * count, dtype=bool)
    used[quads] = True
    used[triangles] = True
    vertices = np.flatnonzero(used)
    quads, triangles = (np.searchsorted(vertices, faces).astype(np.int32) for faces in (quads, triangles))
    if grid.step > 1:
        quads, triangles, source = split_fans(quads, triangles, len(vertices))
        vertices = vertices[source]
    kind, place = np.divmod(vertices, count)
    row, col = np.divmod(place, cols)
    on_border, in_cell = (kind > 0) & (kind < _CENTRE_OF_CELL), kind == _CENTRE_OF_CELL
    direction = np.where(on_border, kind - 1, 0)
    reach = np.where(on_border, np.minimum(grid.reach[direction, row, col], grid.step - 1), 0)
    ahead = np.stack([_ROW_STEP[direction], _COL_STEP[direction]], axis=-1) * on_border[:, None]
    pixel = np.stack([row - 1, col - 1], axis=-1) * grid.step + ahead * reach[:, None]
    inner = (reach > 0) | (grid.reach[(direction + 2) % 4, row, col] > 0)
    other = np.where((on_border & inner)[:, None], pixel - ahead, pixel) + grid.step * in_cell[:, None]
    shift = np.where(in_cell[:, None], grid.step / 2, ahead * BORDER_PX)
    if grid.step > 1:
        shift = drawn_apart(pixel + shift, quads, triangles, source) - pixel
    weight = np.where(in_cell, -0.5, BORDER_PX * on_border)
    return CellFaces(quads, triangles, pixel, other, weight, shift, int(np.count_nonzero(used[:count])))


def _grid(links: Links, step: int) -> _Grid:
    """Return every step-th pixel and how far links reach from it."""
    rows, cols = len(links.right), links.down.shape[1]
    grid_rows, grid_cols = -(-rows // step), -(-cols // step)
    shape = grid_rows + 2, grid_cols + 2
    right = np.zeros((grid_rows * step, grid_cols * step), dtype=bool)
    right[:rows, :cols - 1] = links.right
    down = np.zeros((grid_rows * step, grid_cols * step), dtype=bool)
    down[:rows - 1, :cols] = links.down
    across = right.reshape(grid_rows * step, grid_cols, step)
    along = down.reshape(grid_rows, step, grid_cols * step)

    reach = np.zeros((4, *shape), dtype=np.int64)
    to_right, to_below = across[::step], along[:, :, ::step]
    reach[RIGHT, 1:-1, 1:-1] = np.logical_and.accumulate(to_right, axis=2).sum(axis=2)
    reach[LEFT, 1:-1, 2:] = np.logical_and.accumulate(to_right[:, :, ::-1], axis=2).sum(axis=2)
    reach[DOWN, 1:-1, 1:-1] = np.logical_and.accumulate(to_below, axis=1).sum(axis=1)
    reach[UP, 2:, 1:-1] = np.logical_and.accumulate(to_below[:, ::-1], axis=1).sum(axis=1)

    whole = np.ones((shape[0] - 1, shape[1] - 1), dtype=bool)
    if step > 1:
        rows_linked, cols_linked = np.asarray(across.all(axis=2)), np.asarray(along.all(axis=1))
        below = np.zeros((grid_rows, grid_cols), dtype=bool)
        below[:-1] = rows_linked[step::step]
        beside = np.zeros((grid_rows, grid_cols), dtype=bool)
        beside[:, :-1] = cols_linked[:, step::step]
        whole[1:, 1:] = (rows_linked.reshape(grid_rows, step, grid_cols).all(axis=1) & below
                         & cols_linked.reshape(grid_rows, grid_cols, step).all(axis=2) & beside)
    return _Grid(step, np.ones(shape, dtype=bool), reach, reach[RIGHT] == step, reach[DOWN] == step, whole)


def _without_lines(grid: _Grid) -> _Grid:
    """Return the grid with only the pixels that some cell links to two others, and the links between these."""
    present = np.zeros_like(grid.present)
    corners = present[:-1, :-1], present[1:, :-1], present[1:, 1:], present[:-1, 1:]
    sides = grid.sides()
    for side in range(CORNERS):
        bent = sides[side] & sides[(side + 1) % CORNERS]
        for corner in range(side, side + 3):
            corners[corner % CORNERS][...] |= bent
    right, down = grid.right & present, grid.down & present
    right[:, :-1] &= present[:, 1:]
    down[:-1] &= present[1:]
    return grid._replace(present=present, right=right, down=down)
