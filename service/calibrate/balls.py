"""The balls that a request names by circles and masks, with what is known of their size and place."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from service.calibrate.results import digits
from service.errors import RequestError
from service.light_estimation.ball import Ball, ball_from_circle
from service.light_estimation.ball_outline import ball_from_mask
from service.requests.calibrate import BallRequest
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.errors import CalibrationError, ManifestError
from stage.formats import images

RADIUS_TOLERANCE = 0.05
"""Relative difference of a ball's radius in metres from its radius in pixels × pixel_size_m, above which one of them must be wrong."""


def balls_of(request: BallRequest, camera: Camera, *, exactly: int | None = None, at_least: int = 1,
           radii: Sequence[float] = (), heights: Sequence[float] = ()) -> list[Ball]:
    """Return the balls that a request names: those of its circles, then those of its masks.

    Args:
        exactly: how many balls there must be; None: `at_least` says it.
        at_least: how many balls there must be at least.
        radii: metres, one for all balls or one for each; empty: not known.
        heights: camera-frame z of the centres, one for all balls or one for each; empty: surface_z_m.

    Raises:
        RequestError: the number of balls, radii or heights is not what is needed.
        StageError: a ball lies outside the image, or a mask shows none.
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
    """Check that the size of each ball in metres is known, and that two sources of it agree.

    Raises:
        RequestError: a perspective camera needs --ball-radius-m.
        ManifestError: camera.pixel_size_m is missing, or differs from --ball-radius-m.
    """
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
    """Return a ball as the report holds it."""
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
