"""Levels of detail: a mesh with fewer and fewer faces under the textures of the full one.

The normal map of an asset is relative to the normals of its vertices (service/asset/content/tangent.py), so that all levels must carry the
same ones wherever their vertices lie. Normals of single pixels cannot be carried by faces of many pixels: the normals of the full mesh are
therefore made smooth first, and the normal map says all the rest. Levels take their normals from these.

Source: Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997, as fast-simplification does it: in image
coordinates and relief, so that texture coordinates follow from the places of the vertices, and with open borders left as they are.
"""

import fast_simplification
import numpy as np

from service.asset.content.links import drawn_apart, height_of, joined, relief, split_fans
from service.asset.content.mesh import SurfaceMesh, vertex_normals
from stage.capture.camera import Camera

REDUCTION = 4
"""Faces of a level over those of the next: half of the resolution along both axes."""
SMOOTHINGS = 40
"""Rounds in which a normal becomes the mean of itself and its four neighbours: a standard deviation of four vertices, the side of the faces
of the second level. Fewer leave detail that its faces cannot carry, more bend the normals of small objects."""
_KEYS_PER_PIXEL = 1e4
"""Resolution at which vertices of the border are told apart: simplification returns them as they are, but for the order of their sums."""


def with_smooth_normals(mesh: SurfaceMesh) -> SurfaceMesh:
    """Return the mesh with normals that vary slowly from vertex to vertex, within each patch of faces."""
    row, col = mesh.rows[:mesh.centred] // mesh.step, mesh.cols[:mesh.centred] // mesh.step
    first, second = edges(mesh)
    both = np.maximum(first, second) < mesh.centred
    linked = np.zeros((2, int(row.max()) + 1, int(col.max()) + 1), dtype=bool)
    for a, b in ((first[both], second[both]), (second[both], first[both])):
        for axis, (down, right) in enumerate(((0, 1), (1, 0))):
            beside = (row[b] - row[a] == down) & (col[b] - col[a] == right)
            linked[axis, row[a][beside], col[a][beside]] = True
    across, along = linked[0, :, :-1, None], linked[1, :-1, :, None]
    normal: np.ndarray = np.zeros((*linked.shape[1:], 3), dtype=np.float32)
    normal[row, col] = mesh.normals[:mesh.centred]
    for _ in range(SMOOTHINGS):
        total = normal.copy()
        total[:, 1:] += normal[:, :-1] * across
        total[:, :-1] += normal[:, 1:] * across
        total[1:] += normal[:-1] * along
        total[:-1] += normal[1:] * along
        length = np.sqrt(np.einsum("rcx,rcx->rc", total, total))
        normal = total / np.where(length > 0, length, 1)[..., None]
    smooth = mesh.normals.copy()
    smooth[:mesh.centred] = normal[row, col]
    # vertices of the border take the mean of the pixels that they share edges with
    outer = np.maximum(first, second) >= mesh.centred
    for a, b in ((first[outer], second[outer]), (second[outer], first[outer])):
        inner = (a < mesh.centred) & (b >= mesh.centred)
        total = np.stack([np.bincount(b[inner], smooth[a[inner], axis], minlength=len(smooth)) for axis in range(3)], axis=-1)
        found = total.any(axis=-1)
        smooth[found] = total[found] / np.linalg.norm(total[found], axis=-1, keepdims=True)
    return mesh._replace(normals=smooth)


def level_meshes(mesh: SurfaceMesh, camera: Camera, count: int) -> list[SurfaceMesh]:
    """Return levels of detail of a mesh, each with a quarter of the faces of the one before, and those along the border.

    There are fewer than `count` where the border of the mesh leaves nothing to simplify.
    """
    u, v = mesh.st[:, 0].astype(np.float64) * camera.width, (1 - mesh.st[:, 1].astype(np.float64)) * camera.height
    places = np.stack([u, -v, relief(mesh.points[:, 2].astype(np.float64), camera)], axis=-1)
    triangles = np.concatenate([mesh.quads[:, [0, 1, 2]], mesh.quads[:, [0, 2, 3]], mesh.triangles])
    border = len(mesh.points) - mesh.centred  # a face at each side of the border stays
    full = _Normals(mesh, places)
    levels: list[SurfaceMesh] = []
    level_places, level_triangles = places, triangles
    for _ in range(count):
        before = len(level_triangles)
        target = border + (before - border) // REDUCTION
        level_places, level_triangles = fast_simplification.simplify(level_places, level_triangles, target_count=target,
                                                                     preserve_border=True)
        if len(level_triangles) > before * 3 // 4:
            break
        levels.append(_level(level_places, level_triangles, mesh, camera, full))
    return levels


def edges(mesh: SurfaceMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the two vertices of the side that follows each corner of each face; sides of two faces appear twice."""
    return (np.concatenate([mesh.quads.ravel(), mesh.triangles.ravel()]),
            np.concatenate([np.roll(mesh.quads, -1, axis=1).ravel(), np.roll(mesh.triangles, -1, axis=1).ravel()]))


class _Normals:
    def __init__(self, mesh: SurfaceMesh, places: np.ndarray) -> None:
        self._mesh = mesh
        self._patch = joined(len(places), *edges(mesh))
        border = np.arange(mesh.centred, len(places))
        keys = _keys(places[border])
        order = np.argsort(keys)
        self._keys, self._border = keys[order], border[order]
        row, col = mesh.rows[:mesh.centred] // mesh.step, mesh.cols[:mesh.centred] // mesh.step
        self._vertex = np.full((int(row.max()) + 2, int(col.max()) + 2), -1)  # the last row and column are of no vertex
        self._vertex[row, col] = np.arange(mesh.centred)

    def at(self, places: np.ndarray, triangles: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        """Return normals [V, 3] at the places of a level's vertices; `otherwise` where no vertex of the same patch is near."""
        keys = _keys(places)
        found = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        same = self._keys[found] == keys
        component = joined(len(places), triangles.ravel(), np.roll(triangles, -1, axis=1).ravel())
        patch = np.full(len(places), -1)
        patch[component[same]] = self._patch[self._border[found[same]]]  # every patch has a border, which no level moves
        patch = patch[component]

        u, v = places[:, 0], -places[:, 1]
        row, col = ((place - 0.5) / self._mesh.step for place in (v, u))
        total = np.zeros((len(places), 3))
        for down in (0, 1):
            for right in (0, 1):
                r, c = np.floor(row).astype(int) + down, np.floor(col).astype(int) + right
                weight = (1 - np.abs(row - r)) * (1 - np.abs(col - c))
                vertex = self._vertex[np.clip(r, -1, self._vertex.shape[0] - 1), np.clip(c, -1, self._vertex.shape[1] - 1)]
                total += np.where((vertex >= 0) & (self._patch[vertex] == patch), weight, 0)[:, None] * self._mesh.normals[vertex]
        total[same] = self._mesh.normals[self._border[found[same]]]
        length = np.linalg.norm(total, axis=-1, keepdims=True)
        return np.where(length > 0, total / np.where(length > 0, length, 1), otherwise).astype(np.float32)


def _level(places: np.ndarray, triangles: np.ndarray, mesh: SurfaceMesh, camera: Camera, full: _Normals) -> SurfaceMesh:
    """Return simplified faces as a mesh, without those that simplification turned over."""
    a, b, c = (places[triangles[:, corner], :2] for corner in range(3))
    (x1, y1), (x2, y2) = (b - a).T, (c - a).T
    triangles = triangles[x1 * y2 - x2 * y1 > 0].astype(np.int32)
    none = np.zeros((0, 4), dtype=np.int32)
    _, triangles, source = split_fans(none, triangles, len(places))
    places = drawn_apart(places[source], none, triangles, source)
    used = np.unique(triangles)
    triangles, places = np.searchsorted(used, triangles).astype(np.int32), places[used]
    u, v = places[:, 0], -places[:, 1]
    points = camera.points_over(u, v, height_of(places[:, 2], camera))
    st = np.stack([u / camera.width, 1 - v / camera.height], axis=-1).astype(np.float32)
    normals = full.at(places, triangles, vertex_normals(points, none, triangles))
    rows, cols = (np.clip(np.floor(place).astype(np.int64), 0, size - 1) for place, size in ((v, camera.height), (u, camera.width)))
    return SurfaceMesh(points, normals, st, none, triangles, rows, cols, mesh.step, 0)


def _keys(places: np.ndarray) -> np.ndarray:
    """Return a number for each place [n, 3] that places of one vertex share."""
    u, v, height = np.round(places * _KEYS_PER_PIXEL).astype(np.int64).T
    return (u * np.int64(1_000_003) + v) * np.int64(1_000_033) + height
