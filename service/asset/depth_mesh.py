"""A measured depth as a mesh that is cut where one surface stands in front of another: arrays only, no USD."""

import numpy as np

from service.asset.mesh import SurfaceMesh, height_mesh, without_faces
from stage.depth_breaks import connected, same_surface
from stage.depth_maps import DepthMaps
from stage.maps import SurfaceMaps


def depth_mesh(maps: DepthMaps) -> SurfaceMesh:
    """Return faces between neighbouring pixels, without those across a break of the depth (stage.depth_breaks).

    Args:
        maps: a depth; pixels whose depth is not finite, or not in front of a perspective camera, get no vertex.

    Raises:
        AssetError: there is no face.
    """
    mesh = height_mesh(SurfaceMaps(camera=maps.camera, mask=maps.mask, height=-maps.depth))
    grid = slice(None, None, mesh.step), slice(None, None, mesh.step)
    depth, sigma = maps.depth[grid], None if maps.sigma is None else maps.sigma[grid]
    valid = maps.mask[grid] & np.isfinite(depth)
    if maps.camera.projection == "perspective":
        valid &= depth > 0
    links = [connected(np.where(valid, depth, 1), valid, maps.camera, offset, sigma=sigma, step=mesh.step) for offset in ((1, 0), (0, 1))]
    return without_faces(mesh, np.concatenate([_torn(faces, mesh, maps, *links) for faces in (mesh.quads, mesh.triangles)]))


def _torn(faces: np.ndarray, mesh: SurfaceMesh, maps: DepthMaps, down: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return [faces] bool: True for a face that is steeper than 80° and has a side, in a row or column of pixels, across a break.

    Args:
        faces: [F, corners] vertex numbers.
        down, right: whether each vertex of the grid is connected with the one below it, and with the one on its right.
    """
    if len(faces) == 0:
        return np.zeros(0, dtype=bool)
    corners = -mesh.points[faces, 2].astype(np.float64)
    steep = ~same_surface(corners.min(axis=1), corners.max(axis=1), mesh.step * float(np.sqrt(2)), maps.camera)
    row, col = mesh.rows[faces] // mesh.step, mesh.cols[faces] // mesh.step
    next_row, next_col = np.roll(row, -1, axis=1), np.roll(col, -1, axis=1)
    first = np.minimum(row, next_row), np.minimum(col, next_col)
    across = ((col == next_col) & ~down[first]) | ((row == next_row) & ~right[first])
    return steep & across.any(axis=1)
