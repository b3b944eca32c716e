"""The point cloud of a solved depth, with colours and normals."""

import numpy as np

from service.depth.solution import DepthSolution
from stage.camera import Camera
from stage.colour import convert
from stage.colour_spaces import linear_space
from stage.depth_normals import depth_normals
from stage.ply import PointCloud

WHITE_PERCENTILE = 99.0
"""Percentile of the brightest channel that is shown as full white, so that a few highlights do not darken the cloud."""


def point_cloud(solution: DepthSolution, camera: Camera, *, color_space: str, normals: bool) -> PointCloud:
    """Return one point for each solved pixel, row by row; or the measured places between pixels, if the method has them.

    Args:
        solution: of the whole image.
        camera: of the capture.
        color_space: of the capture's images.
        normals: fit them too.
    """
    solved = solution.solved
    if solution.points is not None and solution.pixels is not None:
        kept = solved[tuple(solution.pixels.T)]
        rows, cols = solution.pixels[kept].T
        points = solution.points[kept]
    else:
        rows, cols = np.nonzero(solved)
        x, y = camera.plane_coordinates()
        depth = solution.depth[rows, cols].astype(np.float64)
        spread = depth if camera.projection == "perspective" else 1.0
        points = np.stack([x[rows, cols] * spread, y[rows, cols] * spread, -depth], axis=-1)
    colours = display_colours(solution, color_space)[rows, cols]
    found = depth_normals(solution.depth, solved, camera, sigma=solution.sigma)[rows, cols] if normals else None
    return PointCloud(points.astype(np.float32), colours, found)


def display_colours(solution: DepthSolution, color_space: str) -> np.ndarray:
    """Return what the scene looks like under even light, its brightest one per cent white: [rows, cols, 3] uint8, sRGB."""
    linear = solution.colour
    if linear is None:
        grey = np.zeros(solution.depth.shape, np.float32) if solution.amplitude is None else solution.amplitude
        linear = np.repeat(grey[..., None], 3, axis=-1)
    return srgb_bytes(linear, white_of(linear[solution.solved].max(axis=-1, initial=0.0)), linear_space(color_space))


def white_of(seen: np.ndarray) -> float:
    """Return the light that is shown as full white; 0 where nothing is seen."""
    return float(np.percentile(seen, WHITE_PERCENTILE)) if seen.size else 0.0


def srgb_bytes(linear: np.ndarray, white: float, color_space: str) -> np.ndarray:
    """Return linear colours for display, [rows, cols, 3] uint8, sRGB, `white` as 255; middle grey if white is 0."""
    shown = np.clip(linear / white, 0, 1) if white > 0 else np.full_like(linear, 0.5)
    encoded = convert(np.ascontiguousarray(shown, dtype=np.float32), color_space, "srgb_texture")
    return np.rint(255 * np.clip(encoded, 0, 1)).astype(np.uint8)
