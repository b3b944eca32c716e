"""The balls of a request: typed circles and masks, with what is known of their size."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from service.calibrate.results import digits
from service.errors import RequestError
from service.requests.calibrate import BallRequest
from stage import images
from stage.calibration.ball import Ball, ball_from_circle
from stage.calibration.outline import ball_from_mask
from stage.camera import Camera
from stage.capture import Capture
from stage.errors import CalibrationError, ManifestError
from stage.manifest import FILE_NAME

RADIUS_TOLERANCE = 0.05
"""How far a ball's radius in metres may be from its radius in pixels × pixel_size_m before one of them must be wrong."""


def balls_of(request: BallRequest, camera: Camera, *, exactly: int | None = None, at_least: int = 1,
           radii: Sequence[float] = (), heights: Sequence[float] = ()) -> list[Ball]:
    """The balls that a request names.

    Raises:
        RequestError: another count than is needed.
        StageError: a ball outside the image, or a mask that shows none.
    """
    count = len(request.circles) + len(request.masks)
    if count < at_least or exactly not in (None, count):
        need = f"exactly {exactly}" if exactly is not None else f"{at_least} or more"
        raise RequestError(f"--ball, --ball-mask: {count} balls are given: this needs {need}")
    for name, values in (("--ball-radius-m", radii), ("--ball-z-m", heights)):
        if len(values) not in (0, 1, count):
            raise RequestError(f"{name}: is given {len(values)} times for {count} balls: give it once, or once a ball")

    def of(values: Sequence[float], index: int) -> float | None:
        return None if not values else values[0] if len(values) == 1 else values[index]

    level = camera.surface_z_m if camera.projection == "orthographic" else None
    places = [(of(radii, index), of(heights, index) if heights else level) for index in range(count)]
    found = [ball_from_circle(camera, circle.u, circle.v, circle.radius_px, radius_m=radius, z_m=z)
             for circle, (radius, z) in zip(request.circles, places, strict=False)]
    for path, (radius, z) in zip(request.masks, places[len(request.circles):], strict=True):
        found.append(_masked_ball(path, camera, radius, z))
    return found


def check_metric(capture: Capture, balls: Sequence[Ball], radii: Sequence[float]) -> None:
    """Refuse balls whose size in metres is not known, or is known twice and differently."""
    if capture.camera.projection == "perspective":
        if not radii:
            raise RequestError("--ball-radius-m: is missing: a perspective camera sees the size of a ball, not its distance")
        return
    where = f"{capture.folder / FILE_NAME}: camera.pixel_size_m"
    for index, ball in enumerate(balls):
        radius = radii[0 if len(radii) == 1 else index] if radii else None
        if not ball.metric:
            hint = "" if radius is None else f": by the ball it is {radius / ball.radius_px:.4g}"
            raise ManifestError(f"{where}: is missing: near lights need a scale{hint}")
        if radius is not None and abs(ball.radius / radius - 1) > RADIUS_TOLERANCE:
            raise ManifestError(f"{where}: by it ball {index + 1} has a radius of {ball.radius:.4g} m, "
                                f"--ball-radius-m says {radius:.4g}")


def ball_entry(ball: Ball) -> dict[str, Any]:
    """A ball for the report."""
    unit = "m" if ball.metric else "px or radii"
    return {"centre": digits(ball.centre), "radius": float(f"{ball.radius:.6g}"), "unit": unit,
            "radius_px": round(ball.radius_px, 3), "outline_error_px": round(ball.outline_error_px, 4)}


def _masked_ball(path: Path, camera: Camera, radius: float | None, z: float | None) -> Ball:
    images.check_resolution(path, camera.resolution)
    coverage = images.read_pixels(path)[..., 0]
    try:
        return ball_from_mask(camera, coverage, radius_m=radius, z_m=z)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
