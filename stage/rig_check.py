"""Whether projector and camera of a capture can measure depth at all: what units and poses most often get wrong."""

import numpy as np

from stage.camera import Camera
from stage.capture import Capture
from stage.errors import ManifestError
from stage.manifest import FILE_NAME
from stage.projector import Projector

LEAST_BASELINE_M, MOST_BASELINE_M = 1e-4, 20.0
"""Between camera and projector: outside, the translation is not in metres."""
GRID = 9
"""Lines of sight in each direction, and depths a decade, that are tried for a place that both devices see."""


def device_from_camera(projector: Projector) -> np.ndarray:
    """The projector's x right, y down, z forward from the camera frame.

    Returns:
        [3, 4] float64: point_device = matrix @ (x, y, z, 1).
    """
    pose = np.array(projector.camera_from_projector, dtype=np.float64)
    turn = np.diag([1.0, -1.0, -1.0]) @ pose[:3, :3].T
    return np.column_stack([turn, -turn @ pose[:3, 3]])


def project(projector: Projector, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates of camera-frame points in the projector.

    Args:
        points: [..., 3] metres.

    Returns:
        [..., 2] continuous column and row, and [...] bool: in front of the projector.
    """
    matrix = device_from_camera(projector)
    own = points @ matrix[:, :3].T + matrix[:, 3]
    ahead = own[..., 2] > 0
    z = np.where(ahead, own[..., 2], 1.0)
    x, y = own[..., 0] / z, own[..., 1] / z
    if projector.distortion is not None:
        x, y = projector.distortion.apply(x, y)
    cu, cv = projector.principal_px or (projector.resolution[0] / 2, projector.resolution[1] / 2)
    return np.stack([cu + projector.focal_px[0] * x, cv + projector.focal_px[1] * y], axis=-1), ahead


def check_perspective(capture: Capture) -> None:
    """Refuse a camera whose lines of sight do not spread: triangulation here starts from a centre.

    Raises:
        ManifestError: it is orthographic.
    """
    if capture.camera.projection != "perspective":
        raise ManifestError(f"{capture.folder / FILE_NAME}: camera.projection: is orthographic: triangulation needs a perspective camera")


def check_projector(capture: Capture) -> Projector:
    """The capture's projector.

    Raises:
        ManifestError: there is none, it stands where the camera does or implausibly far away, or it lights nothing that the
            camera sees.
    """
    where = f"{capture.folder / FILE_NAME}: projector"
    projector = capture.manifest.projector
    if projector is None:
        raise ManifestError(f"{where}: is missing: depth from patterns needs its lens and pose; see relit calibrate procam")
    check_perspective(capture)
    baseline = float(np.linalg.norm(np.array(projector.camera_from_projector)[:3, 3]))
    if baseline < LEAST_BASELINE_M:
        raise ManifestError(f"{where}.camera_from_projector: the projector stands {baseline:.2g} m from the camera: "
                            "without a baseline there is no depth")
    if baseline > MOST_BASELINE_M:
        raise ManifestError(f"{where}.camera_from_projector: the projector stands {baseline:.4g} m from the camera: "
                            "give the translation in metres")
    if not _shares_a_place(capture.camera, projector):
        raise ManifestError(f"{where}.camera_from_projector: the projector lights nothing that the camera sees: "
                            "both look along their -z, +y is up")
    return projector


def _shares_a_place(camera: Camera, projector: Projector) -> bool:
    u, v = np.meshgrid((np.arange(GRID) + 0.5) / GRID * camera.width, (np.arange(GRID) + 0.5) / GRID * camera.height)
    x, y = camera.plane_at(u, v)
    depths = np.logspace(-2, 3, 5 * GRID)
    points = depths[:, None, None, None] * np.stack([x, y, -np.ones_like(x)], axis=-1)
    uv, ahead = project(projector, points)
    return bool((ahead & (uv > 0).all(axis=-1) & (uv < np.array(projector.resolution)).all(axis=-1)).any())
