"""Normals → height, with the capture's camera and the one set of options that every solve uses."""

from collections.abc import Callable

import numpy as np

from kernels.status import Status
from kernels.surface.integrate import Integration, IntegrationOptions, integrate_normals
from service.solve.solution import Solution
from stage.camera import Camera

OPTIONS = IntegrationOptions(discontinuities=True, max_reweightings=0)
"""The surface may break where slopes around a pixel contradict each other: objects hide parts of themselves. The bilateral rounds
that may follow gain little more on real objects and can settle on a wrong break where normals are noisy."""


def mean_height(camera: Camera) -> float:
    """Camera-frame z that the mean of the surface is given: the capture's, else 0, or for a perspective camera without a scale
    the distance at which one pixel spans one unit."""
    if camera.projection == "perspective" and camera.surface_z_m is None:
        assert camera.focal_px is not None
        return -sum(camera.focal_px) / 2
    return camera.surface_z_m or 0.0


def mark_not_facing(camera: Camera, solution: Solution) -> None:
    """A visible surface faces its line of sight: pixels whose normal does not are not solved."""
    x, y, toward = solution.normal
    if camera.projection == "perspective":
        right, up = (plane.reshape(-1) for plane in camera.plane_coordinates())
        toward = toward - x * right - y * up
    solution.status[(solution.status == Status.OK) & (toward <= 0)] = Status.NOT_FACING


def integrate(camera: Camera, normal: np.ndarray, solved: np.ndarray, device: str,
              progress: Callable[[float], None] | None = None) -> Integration | None:
    """Height of the solved pixels.

    Args:
        camera: of the capture.
        normal: [3, pixels] float32.
        solved: [rows, cols] bool.
        device: where.
        progress: told the part done, 0…1.

    Returns:
        The height on the device, or None when no pixel is solved.
    """
    if not solved.any():
        return None
    x, y = camera.plane_coordinates()
    return integrate_normals(normal.reshape(3, *solved.shape), solved, x.astype(np.float32), y.astype(np.float32),
                             perspective=camera.projection == "perspective", mean_z=mean_height(camera), options=OPTIONS,
                             device=device, progress=progress)
