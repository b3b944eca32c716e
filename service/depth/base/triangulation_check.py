"""Checks that a capture can be triangulated, which find the usual mistakes in units and poses."""

import numpy as np

from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.capture.projector import Projector
from stage.errors import ManifestError

LEAST_BASELINE_M, MOST_BASELINE_M = 1e-4, 20.0
"""The range of plausible distances between camera and projector, or two cameras: outside it the translation is not in metres."""
GRID = 9
"""The lines of sight in each direction and the depths in each decade that are searched for a point that camera and projector both see."""


def check_perspective(capture: Capture) -> None:
    """Check that the camera is perspective, because triangulation needs lines of sight from one centre."""
    if capture.camera.projection != "perspective":
        raise ManifestError(f"{capture.folder / FILE_NAME}: camera.projection: is orthographic: triangulation needs a perspective camera")


def missing_calibration(capture: Capture) -> str | None:
    """Return what the manifest lacks for triangulation under projected patterns, as a sentence; None if it lacks nothing."""
    where = f"{capture.folder / FILE_NAME}"
    projector = capture.manifest.projector
    if not isinstance(projector, Projector):
        fault = "is missing" if projector is None else "has no focal_px and no camera_from_projector"
        return f"{where}: projector: {fault}: depth needs its lens and pose; relit calibrate procam measures them"
    if capture.camera.projection != "perspective":
        return f"{where}: camera.projection: is orthographic: triangulation needs a perspective camera"
    return None


def check_projector(capture: Capture) -> Projector:
    """Check that a calibrated projector stands at a plausible place and lights what the camera sees, and return it."""
    where = f"{capture.folder / FILE_NAME}: projector"
    projector, missing = capture.manifest.projector, missing_calibration(capture)
    if missing is not None or not isinstance(projector, Projector):
        raise ManifestError(missing or where)
    baseline = float(np.linalg.norm(np.array(projector.camera_from_projector)[:3, 3]))
    check_baseline(baseline, f"{where}.camera_from_projector: the projector", "the camera")
    if not _see_a_common_point(capture.camera, projector):
        raise ManifestError(f"{where}.camera_from_projector: the projector lights nothing that the camera sees: "
                            "both look along their -z, +y is up")
    return projector


def check_baseline(baseline_m: float, device: str, other: str) -> None:
    """Check that two devices stand at a plausible distance. `device`: the field and the device, `other`: the other, for messages."""
    if baseline_m < LEAST_BASELINE_M:
        raise ManifestError(f"{device} stands {baseline_m:.2g} m from {other}: without a baseline there is no depth")
    if baseline_m > MOST_BASELINE_M:
        raise ManifestError(f"{device} stands {baseline_m:.4g} m from {other}: give the translation in metres")


def _see_a_common_point(camera: Camera, projector: Projector) -> bool:
    u, v = np.meshgrid((np.arange(GRID) + 0.5) / GRID * camera.width, (np.arange(GRID) + 0.5) / GRID * camera.height)
    x, y = camera.plane_at(u, v)
    depths = np.logspace(-2, 3, 5 * GRID)
    points = depths[:, None, None, None] * np.stack([x, y, -np.ones_like(x)], axis=-1)
    uv, ahead = projector.project(points)
    return bool((ahead & (uv > 0).all(axis=-1) & (uv < np.array(projector.resolution)).all(axis=-1)).any())
