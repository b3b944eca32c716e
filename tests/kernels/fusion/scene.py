"""Range images of the statue as kernels take them, and a fusion over all bricks."""

import cv2
import numpy as np

from kernels.fusion.bricks import BLOCK, BRICK, find_blocks
from kernels.fusion.extract import extract
from kernels.fusion.integrate import integrate
from kernels.fusion.views import RangeImage, upload_views
from stage.capture.camera import Camera
from stage.results.depth_breaks import connected
from stage.results.depth_normals import depth_normals
from tests.scenes.statue import Shot


def range_image(shot: Shot, sigma: float, *, world_from_camera=None) -> RangeImage:
    rows, cols = shot.side
    camera = Camera(projection="perspective", resolution=(cols, rows), focal_px=(shot.focal, shot.focal))
    sigmas = np.full(shot.side, sigma, dtype=np.float32)
    normal = depth_normals(shot.depth, shot.mask, camera, sigma=sigmas, radius=2)
    right, down, across, back = (connected(shot.depth, shot.mask, camera, offset, sigma=sigmas)
                                 for offset in ((0, 1), (1, 0), (1, 1), (1, -1)))
    cell = np.zeros(shot.side, dtype=bool)
    cell[:-1, :-1] = right[:-1, :-1] & right[1:, :-1] & down[:-1, :-1] & down[:-1, 1:] & across[:-1, :-1] & back[:-1, 1:]
    corners = np.stack([shot.depth[:-1, :-1], shot.depth[:-1, 1:], shot.depth[1:, :-1], shot.depth[1:, 1:]])
    steepest = np.tan(np.radians(70)) * corners.min(axis=0) / shot.focal + 4 * np.sqrt(2) * sigma
    cell[:-1, :-1] &= np.ptp(corners, axis=0) <= steepest
    clear = cv2.erode(np.where(shot.mask, shot.depth, 0).astype(np.float32), np.ones((5, 5)), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    pose = shot.world_from_camera if world_from_camera is None else world_from_camera
    return RangeImage(shot.depth, sigmas, normal, cell, clear, np.linalg.inv(pose), (shot.focal, shot.focal), (cols / 2, rows / 2))


def fuse(images: list[RangeImage], voxel: float, low, high, *, blocks: int = BRICK, device: str):
    """Points, standard deviations and faces of the surface within a box, welded over all bricks of so many blocks."""
    size = blocks * BLOCK * voxel
    first, last = (np.floor(np.array(corner) / size).astype(int) for corner in (low, high))
    views = upload_views(images, np.zeros(3), device=device)
    points, sigmas, keys, faces, count = [], [], [], [], 0
    for brick in np.ndindex(*(last - first + 1)):
        corner = (np.array(brick) + first) * (blocks * BLOCK)
        found = extract(integrate(find_blocks(views, voxel, tuple(map(int, corner)), blocks, device=device), views))
        points.append(found.points)
        sigmas.append(found.sigma)
        keys.append(found.edge)
        faces.append(found.faces + count)
        count += len(found.points)
    _, kept, number = np.unique(np.concatenate(keys), axis=0, return_index=True, return_inverse=True)
    return np.concatenate(points)[kept], np.concatenate(sigmas)[kept], number.ravel()[np.concatenate(faces)]


def edge_counts(faces: np.ndarray) -> np.ndarray:
    """How many edges have how many faces, by that number."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.bincount(np.unique(edges, axis=0, return_counts=True)[1])
