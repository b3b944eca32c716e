"""The balls of a calibration: those that a request names by circles and masks, or else those that are found in the images."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from service.calibrate.results import LightCaptures, digits
from service.calibrate.solvers.apply import LitFrame, as_direction
from service.calibrate.solvers.ball_search import find_outlines, outline_near
from service.calibrate.solvers.mirror_ball import find_spot, still_light
from service.errors import RequestError
from service.light_estimation.ball import Ball, BallView, ball_from_circle, ball_from_mask, fit_circle, project, view_ball
from service.light_estimation.grey_ball import fit_brightness, fit_direction
from service.requests.calibrate import BallRequest
from service.requests.rig import RigCalibrationRequest
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.errors import CalibrationError, ManifestError
from stage.formats import images
from stage.stack.correction import Correction

PLAUSIBLE_RADIUS_M = 2e-4, 1.0
"""Radii of calibration balls, from those of bearings to those of gazing globes; beyond them the unit is another."""
RADIUS_TOLERANCE = 0.05
"""Relative difference of a ball's radius in metres from its radius in pixels × pixel_size_m, above which one of them must be wrong."""
FRAMES = 16
"""The most frames in which each outline is looked at."""
SPANS, LEAST_SPAN = 4, 2
"""In how many runs of these frames a ball is looked for to tell whether it moved, and the least frames of one: twelve right lights move it
by .8 px at most."""
CANDIDATES = 12
"""The most outlines that are looked at."""
WHITE = 0.995
"""The quantile of a frame that is shown white."""
GAMMA = 0.45
"""Exponent with which frames are shown, so that dark outlines count."""
LEAST_FRAMES = 0.7
"""The part of the frames that must agree that an outline is that of the ball: some lights stand behind it."""
ASIDE_PX = 1.5
"""How far a named ball may lie from the outline in the images without a word, which what stands around a mirror moves by a pixel."""
OTHER_SIZE = 1.6
"""Ratio of the radii of a named ball and of a round outline there up to which both are one ball: lamps and windows in it are smaller."""
LEAST_MOVE = 0.05
"""The least standard deviation of the place of the spot over the frames, relative to the radius: the lamp of the room stands still."""
GREY_RESIDUAL = 0.1
"""The largest residual of the shading of a grey ball; a flat disc leaves 0.3."""
DARK = 0.05
"""An outline whose brightest frame is darker than this part of the brightest pixels is that of a shadow."""


def balls_of(request: BallRequest | RigCalibrationRequest, camera: Camera, *, exactly: int | None = None, at_least: int = 1,
           radii: Sequence[float] = (), heights: Sequence[float] = ()) -> list[Ball]:
    """Return the balls that a request names: those of its circles, then those of its masks.
    `exactly`: how many balls there must be; None: `at_least` says it. `radii`: metres, one for all balls or one for each; empty: not known.
    `heights`: camera-frame z of the centres, one for all balls or one for each; empty: surface_z_m."""
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


def compared(request: BallRequest, balls: Sequence[Ball], captures: LightCaptures) -> tuple[list[Ball], list[str]]:
    """Compare the balls that a request names with the outlines that the images show near them.
    Returns the balls, as far off as they lie from these outlines, and a sentence for each that lies aside."""
    names = [*(f"--ball {circle.u:g},{circle.v:g},{circle.radius_px:g}" for circle in request.circles),
             *(f"--ball-mask {path}" for path in request.masks)]
    camera = captures.source.camera
    pictures = _pictures(captures, Correction.of(captures.source), evenly(len(captures.lit), FRAMES))
    result, said = [], []
    for name, ball in zip(names, balls, strict=True):
        outline = outline_near(camera, pictures, ball) or next((one for one in find_outlines(camera, pictures) if _overlap(
            camera, ball, one.ball) and max(one.ball.radius_px / ball.radius_px, ball.radius_px / one.ball.radius_px) < OTHER_SIZE), None)
        if outline is not None:
            named, seen = ((*project(camera, each.centre), each.radius_px) for each in (ball, outline.ball))
            aside = float(np.linalg.norm(np.subtract(named, seen)))
            ball = ball._replace(outline_error_px=float(np.linalg.norm([ball.outline_error_px, aside, outline.ball.bent_px])),
                                 oval_px=outline.ball.oval_px, off_axis_degrees=outline.ball.off_axis_degrees)
            if aside > ASIDE_PX:
                (u, v), radius = fit_circle(outline.points)
                said.append(f"{name}: lies {aside:.1f} px from the outline that the images show there, {u:.1f},{v:.1f},{radius:.1f}: what "
                            "is measured is as much less sure; leave the ball out, or give that outline")
        result.append(ball)
    return result, said


def examined(captures: LightCaptures, balls: Sequence[Ball]) -> tuple[list[Ball], list[str]]:
    """Compare where balls lie in the course of a capture. Returns them, as far off as they moved, and a sentence for each that moved or
    whose outline is an ellipse."""
    camera, correction = captures.source.camera, Correction.of(captures.source)
    spans = [span for span in np.array_split(evenly(len(captures.lit), FRAMES), SPANS) if len(span) >= LEAST_SPAN]
    pictures = [_pictures(captures, correction, span) for span in spans]
    result, said = [], []
    for ball in balls:
        places = [None if seen is None else seen.middle for seen in (outline_near(camera, shown, ball) for shown in pictures)]
        pairs = [(float(np.linalg.norm(one - other)), number, before) for number, one in enumerate(places) if one is not None
                 for before, other in enumerate(places[:number]) if other is not None]
        moved, later, earlier = max(pairs, default=(0.0, 0, 0))
        if moved > ASIDE_PX:
            ball = ball._replace(outline_error_px=float(np.hypot(ball.outline_error_px, moved)))
            here, there = (" to ".join(captures.lit[span[end]].frame.image for end in (0, -1)) for span in (spans[later], spans[earlier]))
            said.append(f"frames: the ball of {ball.radius_px:.0f} px lies {moved:.1f} px aside from {here} of where it lies from {there}: "
                        "it or the camera moved: what is measured is as much less sure; calibrate the frames before and after that "
                        "apart, or take them again")
        if ball.oval_px:
            cause, mend = ((f" towards the image centre, as a perspective camera sees it {ball.off_axis_degrees:.0f}° off its axis", "")
                           if ball.off_axis_degrees else (", as where images were resized in one direction, or a perspective camera is "
                                                          "declared orthographic", "images with square pixels, and "))
            longer = 200 * ball.oval_px / ball.radius_px
            said.append(f"the ball of {ball.radius_px:.0f} px: its outline is an ellipse, {longer:.0f} % longer than wide{cause}: what is "
                        f"measured is as much less sure; give {mend}camera.projection, focal_px and principal_px")
        result.append(ball)
    return result, said


def check_metric(capture: Capture, balls: Sequence[Ball], radii: Sequence[float]) -> None:
    """Check that the size of each ball in metres is known and plausible, and that two sources of it agree."""
    odd = next((radius for radius in radii if not PLAUSIBLE_RADIUS_M[0] <= radius <= PLAUSIBLE_RADIUS_M[1]), None)
    if odd is not None:
        raise RequestError(f"--ball-radius-m: is {odd:g}, and no calibration ball has a radius of {odd:g} m: give it in metres")
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


def still_on(captures: LightCaptures, correction: Correction, views: Sequence[BallView]) -> list[np.ndarray | None]:
    """Return what up to 16 frames of a capture all show on each ball, [h, w] in the box of its view; None for two frames or fewer."""
    return [_still(frames) for frames in _seen_in(captures, correction, views)]


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


class _Seen(NamedTuple):
    """The pixels of one frame within an outline."""

    lit: LitFrame
    radiance: np.ndarray
    saturated: np.ndarray | None


def find_mirror_ball(captures: LightCaptures, level: float) -> Ball:
    """Find the mirror ball, the only round outline in which the bright spot is small and moves from frame to frame."""
    return _only(captures, "mirror", _mirrors(captures, level, None, None))


def find_mirror_balls(captures: LightCaptures, level: float, radius_m: float | None, z_m: float | None) -> list[Ball]:
    """Find the mirror balls of a capture: two round outlines or more in which the bright spot is small and moves from frame to frame.
    `captures`: lit by one lamp a frame. `radius_m`: of every ball; None: not known. `z_m`: camera-frame z of every centre, for an
    orthographic camera; None: not known."""
    found = _mirrors(captures, level, radius_m, z_m)
    if len(found.balls) < 2:
        counted = "no mirror ball is" if not found.balls else "1 mirror ball is"
        raise RequestError(f"{captures.source.folder}: {counted} found in the images ({found.looked_at} round outlines "
                           "were looked at), and near lights need two or more: name them with --ball U,V,R or --ball-mask FILE, once each")
    return found.balls


class _Found(NamedTuple):
    balls: list[Ball]
    looked_at: int
    """The number of round outlines."""


def _mirrors(captures: LightCaptures, level: float, radius_m: float | None, z_m: float | None) -> _Found:
    def is_mirror(ball: Ball, view: BallView, frames: list[_Seen]) -> bool:
        places = []
        still = _still(frames)
        for seen in frames:
            try:
                places.append(find_spot(seen.radiance, seen.saturated, ball, view, level=level, still=still).uv)
            except CalibrationError:
                continue
        if len(places) < LEAST_FRAMES * len(frames):
            return False
        return len(frames) == 1 or float(np.hypot(*np.std(places, axis=0))) > LEAST_MOVE * ball.radius_px

    return _find(captures, is_mirror, radius_m, z_m)


def find_grey_ball(captures: LightCaptures, radius_m: float | None, z_m: float | None) -> Ball:
    """Find the grey ball, the only round outline with the shading of a Lambertian ball under one distant light a frame."""
    def is_grey(ball: Ball, view: BallView, frames: list[_Seen]) -> bool:
        residuals = []
        for seen in frames:
            try:
                direction = fit_direction(seen.radiance, seen.saturated, view).direction
                light = as_direction(seen.lit.light, direction)
                residuals.append(fit_brightness(seen.radiance, seen.saturated, light, view).residual)
            except CalibrationError:
                residuals.append(np.inf)
        return float(np.mean(np.array(residuals) < GREY_RESIDUAL)) >= LEAST_FRAMES

    return _only(captures, "grey", _find(captures, is_grey, radius_m, z_m))


def _find(captures: LightCaptures, is_ball: Callable[[Ball, BallView, list[_Seen]], bool], radius_m: float | None,
          z_m: float | None) -> _Found:
    camera, correction = captures.source.camera, Correction.of(captures.source)
    pictures = _pictures(captures, correction, range(len(captures.lit)))
    brightest = pictures[1]
    outlines = find_outlines(camera, pictures)[:CANDIDATES]
    placed = [(outline, outline.place(camera, radius_m, z_m)) for outline in outlines]
    views = [view_ball(ball, camera) for _, ball in placed]
    seen = _seen_in(captures, correction, views)
    balls: list[Ball] = []
    for (_, ball), view, frames in zip(placed, views, seen, strict=True):
        if brightest[view.box][view.inside].max(initial=0) < DARK or any(_overlap(camera, ball, other) for other in balls):
            continue
        if is_ball(ball, view, frames):
            balls.append(ball)
    return _Found(balls, len(outlines))


def _still(frames: Sequence[_Seen]) -> np.ndarray | None:
    return still_light([seen.radiance for seen in frames], [seen.saturated for seen in frames])


def _seen_in(captures: LightCaptures, correction: Correction, views: Sequence[BallView]) -> list[list[_Seen]]:
    """Return the pixels of up to 16 frames within each outline."""
    seen: list[list[_Seen]] = [[] for _ in views]
    for number in evenly(len(captures.lit), FRAMES):
        lit = captures.lit[number]
        frame = correction.apply(lit.frame)
        for view, frames in zip(views, seen, strict=True):
            frames.append(_Seen(lit, frame.pixels[view.box], None if frame.saturated is None else frame.saturated[view.box]))
    return seen


def _pictures(captures: LightCaptures, correction: Correction, chosen: Sequence[int] | np.ndarray) -> list[np.ndarray]:
    """Return the mean and the brightest of frames, [rows, cols] 0 to 1, as outlines are looked for. `chosen`: the numbers of the frames."""
    camera = captures.source.camera
    mean, brightest = np.zeros((camera.height, camera.width)), np.zeros((camera.height, camera.width))
    for number in chosen:
        grey = correction.apply(captures.lit[number].frame).pixels.mean(axis=-1, dtype=np.float64)
        shown = np.clip(grey / max(float(np.quantile(grey, WHITE)), 1e-12), 0, 1) ** GAMMA
        mean += shown / len(chosen)
        brightest = np.maximum(brightest, shown)
    return [mean, brightest]


def _only(captures: LightCaptures, kind: str, found: _Found) -> Ball:
    """Return the only ball that was found, or raise RequestError."""
    where = captures.source.folder
    balls, camera = found.balls, captures.source.camera
    if not balls:
        raise RequestError(f"{where}: no {kind} ball is found in the images ({found.looked_at} round outlines were looked at): name it "
                           "with --ball U,V,R or --ball-mask FILE")
    if len(balls) > 1:
        named = " and ".join(",".join(f"{value:.1f}" for value in (*project(camera, ball.centre), ball.radius_px)) for ball in balls)
        raise RequestError(f"{where}: {len(balls)} {kind} balls are found, at {named} (U,V,R): name one of them with --ball")
    return balls[0]


def _overlap(camera: Camera, one: Ball, other: Ball) -> bool:
    (u, v), (other_u, other_v) = project(camera, one.centre), project(camera, other.centre)
    return bool(np.hypot(u - other_u, v - other_v) < max(one.radius_px, other.radius_px))
