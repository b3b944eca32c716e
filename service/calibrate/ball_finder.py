"""The mirror or grey balls of a capture, found in its images where the request names none."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from service.calibrate.results import LightCaptures
from service.calibrate.solvers.apply import LitFrame, as_direction
from service.calibrate.solvers.ball_search import find_outlines
from service.calibrate.solvers.mirror_ball import SpotOptions, find_spot
from service.errors import RequestError
from service.light_estimation.ball import Ball, BallView, project, view_ball
from service.light_estimation.grey_ball import fit_brightness, fit_direction
from stage.capture.camera import Camera
from stage.errors import CalibrationError
from stage.stack.correction import Correction

FRAMES = 16
"""The most frames in which each outline is looked at."""
CANDIDATES = 12
"""The most outlines that are looked at."""
WHITE = 0.995
"""The quantile of a frame that is shown white."""
GAMMA = 0.45
"""Exponent with which frames are shown, so that dark outlines count."""
LEAST_FRAMES = 0.7
"""The part of the frames that must agree that an outline is that of the ball: some lights stand behind it."""
LEAST_MOVE = 0.05
"""The least standard deviation of the place of the spot over the frames, relative to the radius: the lamp of the room stands still."""
GREY_RESIDUAL = 0.1
"""The largest residual of the shading of a grey ball; a flat disc leaves 0.3."""
DARK = 0.05
"""An outline whose brightest frame is darker than this part of the brightest pixels is that of a shadow."""


class _Seen(NamedTuple):
    """The pixels of one frame within an outline."""

    lit: LitFrame
    radiance: np.ndarray
    saturated: np.ndarray | None


def find_mirror_ball(captures: LightCaptures, options: SpotOptions) -> Ball:
    """Find the mirror ball: a round outline in which the bright spot is small and moves from frame to frame.

    Raises:
        RequestError: no ball is found, or more than one.
    """
    return _only(captures, "mirror", _mirrors(captures, options, None, None))


def find_mirror_balls(captures: LightCaptures, options: SpotOptions, radius_m: float | None, z_m: float | None) -> list[Ball]:
    """Find the mirror balls of a capture: all round outlines in which the bright spot is small and moves from frame to frame.

    Args:
        captures: lit by one lamp a frame.
        radius_m: of every ball; None: not known.
        z_m: camera-frame z of every centre, for an orthographic camera; None: not known.

    Raises:
        RequestError: fewer than two balls are found.
    """
    found = _mirrors(captures, options, radius_m, z_m)
    if len(found.balls) < 2:
        raise RequestError(f"{captures.source.folder}: {_counted(len(found.balls))} found in the images ({found.looked_at} round outlines "
                           "were looked at), and near lights need two or more: name them with --ball U,V,R or --ball-mask FILE, once each")
    return found.balls


class _Found(NamedTuple):
    """The balls of a capture."""

    balls: list[Ball]
    looked_at: int
    """The number of round outlines."""


def _mirrors(captures: LightCaptures, options: SpotOptions, radius_m: float | None, z_m: float | None) -> _Found:
    def is_mirror(ball: Ball, view: BallView, frames: list[_Seen]) -> bool:
        places = []
        for seen in frames:
            try:
                places.append(find_spot(seen.radiance, seen.saturated, ball, view, options).uv)
            except CalibrationError:
                continue
        if len(places) < LEAST_FRAMES * len(frames):
            return False
        return len(frames) == 1 or float(np.hypot(*np.std(places, axis=0))) > LEAST_MOVE * ball.radius_px

    return _find(captures, is_mirror, radius_m, z_m)


def _counted(count: int) -> str:
    return "no mirror ball is" if count == 0 else f"{count} mirror ball is"


def find_grey_ball(captures: LightCaptures, radius_m: float | None, z_m: float | None) -> Ball:
    """Find the grey ball: a round outline with the shading of a Lambertian ball under one distant light a frame.

    Raises:
        RequestError: no ball is found, or more than one.
    """
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
    mean, brightest = np.zeros((camera.height, camera.width)), np.zeros((camera.height, camera.width))
    for lit in captures.lit:
        grey = correction.apply(lit.frame).pixels.mean(axis=-1, dtype=np.float64)
        shown = np.clip(grey / max(float(np.quantile(grey, WHITE)), 1e-12), 0, 1) ** GAMMA
        mean += shown / len(captures.lit)
        brightest = np.maximum(brightest, shown)
    outlines = find_outlines(camera, [mean, brightest])[:CANDIDATES]
    placed = [(outline, outline.place(camera, radius_m, z_m)) for outline in outlines]
    views = [view_ball(ball, camera) for _, ball in placed]
    seen: list[list[_Seen]] = [[] for _ in placed]
    for number in evenly(len(captures.lit), FRAMES):
        lit = captures.lit[number]
        frame = correction.apply(lit.frame)
        for view, frames in zip(views, seen, strict=True):
            frames.append(_Seen(lit, frame.pixels[view.box], None if frame.saturated is None else frame.saturated[view.box]))
    balls: list[Ball] = []
    for (_, ball), view, frames in zip(placed, views, seen, strict=True):
        if brightest[view.box][view.inside].max(initial=0) < DARK or any(_overlap(camera, ball, other) for other in balls):
            continue
        if is_ball(ball, view, frames):
            balls.append(ball)
    return _Found(balls, len(outlines))


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
