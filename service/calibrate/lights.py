"""Calibration of lights from images of balls (directions, positions, brightness) or of the object (brightness), with residuals."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from service.calibrate.balls import (
    ball_entry,
    balls_of,
    check_metric,
    compared,
    examined,
    find_grey_ball,
    find_mirror_ball,
    find_mirror_balls,
    still_on,
)
from service.calibrate.light_faults import (
    ALIEN,
    LEAST_ALIEN,
    as_unsure_as_rays_miss,
    at_one_place,
    beside,
    missing_sentence,
    with_beside,
    with_clipped,
    with_wide_spots,
)
from service.calibrate.results import (
    LightCalibration,
    LightCaptures,
    MeasuredLight,
    digits,
    leave_out_failures,
    open_captures,
    three_numbers,
    write_lights,
)
from service.calibrate.solvers.apply import LitFrame, SingleLight, as_direction, as_position, lit_frames, with_brightness
from service.calibrate.solvers.lamp_faults import encoding_flag
from service.calibrate.solvers.mirror_ball import find_spot, nearest_point
from service.errors import RequestError
from service.light_estimation.ball import Ball, BallView, view_ball
from service.light_estimation.grey_ball import better_encoding, dark_side, fit_brightness, fit_direction
from service.light_estimation.semi_calibrated import Intensities, check_directions, fit_intensities, light_from_elsewhere, uncertainty_of
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import GreyBallRequest, IntensityRequest, LightPositionsRequest, MirrorBallRequest
from stage.capture.light import DistantLight, PointLight
from stage.capture.manifest import FILE_NAME
from stage.errors import CalibrationError, ManifestError
from stage.stack.correction import Correction

ANALYSER_GAIN = 2.0
"""Irradiance of a light over what a matt ball behind an analyser shows of it: its light has no polarisation left, half passes."""
READERS = 4
"""Images that are decoded at the same time: bounds the memory."""
UNSURE = 0.05
"""Median uncertainty of the brightness of lights, relative, from which the object is said to be none to measure them on."""
ROOM_LIGHT = 0.03
"""Light on the dark side of a ball or an object, over that where it faces a lamp, from which on it is said; dark rooms give one or two
percent."""
BEHIND_Z = -0.2
"""A light with z below this, more than 101° from the view axis, is flagged: the object shows it at grazing angles only."""


class BallPixels(NamedTuple):
    """The pixels of one frame in the box around a ball."""

    radiance: np.ndarray  # [h, w, 3] float32
    saturated: np.ndarray | None  # [h, w] bool
    still: np.ndarray | None = None  # [h, w] what all frames show


def mirror_ball(request: MirrorBallRequest, progress: Progress | None = None) -> LightCalibration:
    """Measure the directions of distant lights from the bright spot on one mirror ball."""
    captures, timings = open_captures(request, progress)
    warnings: list[str] = []
    if request.circles or request.masks:
        (ball,), warnings = compared(request, balls_of(request, captures.source.camera, exactly=1), captures)
    else:
        ball = find_mirror_ball(captures, request.level)
    (ball,), said = examined(captures, [ball])
    warnings += said
    view = view_ball(ball, captures.source.camera)
    # what is not measured stays as the target has it
    targets = _targets(captures)

    def measure(lit: LitFrame, patches: Sequence[BallPixels]) -> MeasuredLight:
        spot = find_spot(patches[0].radiance, patches[0].saturated, ball, view, level=request.level, still=patches[0].still)
        light = targets[lit.number]
        flags = [*spot.flags, *(["irradiance set to 1"] if isinstance(light, PointLight) else [])]
        entry = {"direction": digits(spot.direction), "uncertainty_degrees": round(spot.uncertainty_degrees, 4),
                 "spot_degrees": round(spot.spot_degrees, 3), "spot_pixels": spot.pixels, "spot_uv": digits(spot.uv),
                 "flags": flags}
        row = (three_numbers(spot.direction), f"{spot.uncertainty_degrees:.2f}°", f"{spot.spot_degrees:.2f}°")
        return MeasuredLight(as_direction(light, spot.direction), entry, row, spot.uncertainty_degrees)

    results = with_wide_spots(_measure_each(captures, [view], measure, timings, mirrors=True, drop_failed=request.drop_failed))
    timings.close()
    return write_lights("mirror-ball", request, captures, results, headings=("direction", "sure to", "spot"),
                        summary={"balls": [ball_entry(ball)]}, warnings=[*warnings, *at_one_place(captures, results)])


def light_positions(request: LightPositionsRequest, progress: Progress | None = None) -> LightCalibration:
    """Measure the positions of near lights from the bright spots on two or more mirror balls."""
    captures, timings = open_captures(request, progress)
    camera = captures.source.camera
    named = bool(request.circles or request.masks)
    balls = (balls_of(request, camera, at_least=2, radii=request.ball_radius_m, heights=request.ball_z_m) if named
             else _balls_in_sight(request, captures))
    check_metric(captures.source, balls, request.ball_radius_m)
    balls, warnings = compared(request, balls, captures) if named else (balls, [])
    balls, said = examined(captures, balls)
    warnings += said
    views = [view_ball(ball, camera) for ball in balls]
    middle = np.mean([ball.centre for ball in balls], axis=0)
    targets = _targets(captures)

    def measure(lit: LitFrame, patches: Sequence[BallPixels]) -> MeasuredLight:
        spots = []
        for number, (patch, ball, view) in enumerate(zip(patches, balls, views, strict=True), start=1):
            try:
                spots.append(find_spot(patch.radiance, patch.saturated, ball, view, level=request.level, still=patch.still))
            except CalibrationError as error:
                raise CalibrationError(f"ball {number}: {error}") from error
        found = nearest_point(np.array([spot.point for spot in spots]), np.array([spot.direction for spot in spots]),
                              np.array([spot.uncertainty_degrees for spot in spots]))
        flags = [*found.flags, *(f"ball {n}: {flag}" for n, spot in enumerate(spots, start=1) for flag in spot.flags)]
        entry = {"position_m": digits(found.position), "residual_m": float(f"{found.residual:.3g}"),
                 "uncertainty_m": float(f"{found.uncertainty:.3g}"), "excess": float(f"{found.excess:.3g}"), "flags": flags}
        row = (three_numbers(found.position), f"{found.uncertainty:.2g} m", f"{found.residual:.2g} m")
        return MeasuredLight(as_position(targets[lit.number], found.position, middle), entry, row, found.uncertainty)

    results = as_unsure_as_rays_miss(_measure_each(captures, views, measure, timings, mirrors=True, drop_failed=request.drop_failed))
    timings.close()
    missing = missing_sentence(results)
    if not named and missing:
        raise CalibrationError(f"{captures.source.folder}: the reflections in the {len(balls)} round outlines that were found do not meet "
                               "in most frames: not all of them are mirror balls of this size; name the balls with --ball U,V,R or "
                               "--ball-mask FILE")
    return write_lights("light-positions", request, captures, results, headings=("position, m", "sure to", "residual"),
                        summary={"balls": [ball_entry(ball) for ball in balls]},
                        warnings=[*warnings, *missing, *at_one_place(captures, results)])


def _balls_in_sight(request: LightPositionsRequest, captures: LightCaptures) -> list[Ball]:
    """Find the mirror balls of a capture, all of one size and at one height."""
    for name, values in (("--ball-radius-m", request.ball_radius_m), ("--ball-z-m", request.ball_z_m)):
        if len(values) > 1:
            raise RequestError(f"{name}: is given {len(values)} times, and no ball is named that each belongs to: name the balls with "
                               "--ball or --ball-mask in the same order")
    camera = captures.source.camera
    if camera.projection == "perspective" and not request.ball_radius_m:
        check_metric(captures.source, [], request.ball_radius_m)
    level = camera.surface_z_m if camera.projection == "orthographic" else None
    return find_mirror_balls(captures, request.level, next(iter(request.ball_radius_m), None), next(iter(request.ball_z_m), level))


def grey_ball(request: GreyBallRequest, progress: Progress | None = None) -> LightCalibration:
    """Measure the irradiance or intensity of each light from the shading of one grey ball."""
    captures, timings = open_captures(request, progress)
    camera = captures.source.camera
    warnings: list[str] = []
    if request.circles or request.masks:
        (ball,), warnings = compared(request, balls_of(
            request, camera, exactly=1, radii=() if request.ball_radius_m is None else (request.ball_radius_m,),
            heights=() if request.ball_z_m is None else (request.ball_z_m,)), captures)
    else:
        level = camera.surface_z_m if camera.projection == "orthographic" else None
        ball = find_grey_ball(captures, request.ball_radius_m, level if request.ball_z_m is None else request.ball_z_m)
    (ball,), said = examined(captures, [ball])
    warnings += said
    near = next((lit for lit in captures.lit if isinstance(lit.light, PointLight)), None)
    if near is not None:
        where = f"{captures.source.folder / FILE_NAME}: frames[{near.number}].light: is point"
        if request.refine_direction:
            raise ManifestError(f"{where}: --refine-direction is for distant lights")
        if not ball.metric:
            need = "camera.pixel_size_m" if camera.projection == "orthographic" else "--ball-radius-m"
            raise ManifestError(f"{where}: its distance to the ball needs {need}")
    view = view_ball(ball, camera)

    def measure(lit: LitFrame, patches: Sequence[BallPixels]) -> MeasuredLight:
        patch, light, entry = patches[0], lit.light, {}
        saturated, flags = with_clipped(patch.radiance, patch.saturated, view)
        if request.refine_direction:
            shading = fit_direction(patch.radiance, saturated, view)
            light = as_direction(light, shading.direction)
            turned = np.degrees(ball.outline_error_px / ball.radius_px)  # normals are, and the direction with them
            sure_to = float(np.hypot(shading.uncertainty_degrees, turned))
            entry = {"direction": digits(shading.direction), "uncertainty_degrees": round(sure_to, 4)}
        found = fit_brightness(patch.radiance, saturated, light, view)
        declared = captures.source.manifest.color_space
        other = better_encoding(patch.radiance, saturated, light, view, exposure=lit.frame.exposure_s or 1.0, declared=declared,
                                residual=found.residual)
        flags += ["not Lambertian under this light"] if found.residual > 0.1 else []
        if other is not None:
            flags = [encoding_flag(declared, *other, found.residual)]
        else:
            entry |= beside(patch.radiance, saturated, light, ball, view)
        room = dark_side(patch.radiance, saturated, light, view, found.scale)
        scale = found.scale * (ANALYSER_GAIN if light.polarization != "none" else 1)
        entry |= {"scale": digits(scale), "residual": round(found.residual, 5), "pixels": found.pixels,
                  "dark_side": None if room is None else round(room, 4), "flags": flags}
        return MeasuredLight(with_brightness(light, scale), entry, (), found.residual)

    results = _measure_each(captures, [view], measure, timings, mirrors=False, drop_failed=request.drop_failed)
    timings.close()
    results, said = with_beside(captures, results)
    told = [result.entry for result in results if result.light is not None and result.entry["dark_side"] is not None]
    fitting = [entry for entry in told if not entry["flags"]] or told  # a light from elsewhere than declared reaches that side
    room_light = float(np.median([entry["dark_side"] for entry in fitting])) if fitting else 0.0
    if room_light > ROOM_LIGHT:
        warnings = [*warnings, f"the dark side of the ball has {100 * room_light:.0f} % of the light, from the room or a dark level of the "
                               "camera, which makes irradiances and directions wrong: add a frame of type off, or a dark image"]
    return write_lights("grey-ball", request, captures, _scaled(results, request.albedo),
                        headings=("irradiance", "residual"), summary={"balls": [ball_entry(ball)]}, relative=request.albedo is None,
                        warnings=[*warnings, *said])


def _measure_each(captures: LightCaptures, views: Sequence[BallView],
                  measure: Callable[[LitFrame, Sequence[BallPixels]], MeasuredLight],
                  timings: Timings, *, mirrors: bool, drop_failed: bool) -> list[MeasuredLight]:
    """Measure the light of every lit frame; one that cannot be measured is left out as `leave_out_failures` does.
    `mirrors`: whether the balls show the room, of which the patches then say what stands still."""
    correction = Correction.of(captures.source, full_scale=not mirrors)
    still = still_on(captures, correction, views) if mirrors else [None] * len(views)

    def one(lit: LitFrame) -> MeasuredLight | CalibrationError:
        radiance = correction.apply(lit.frame)
        patches = [BallPixels(radiance.pixels[view.box], None if radiance.saturated is None else radiance.saturated[view.box], rest)
                   for view, rest in zip(views, still, strict=True)]
        try:
            return measure(lit, patches)
        except CalibrationError as error:
            return error

    timings.stage("frames", len(captures.lit))
    results: list[MeasuredLight | CalibrationError] = []
    with ThreadPoolExecutor(min(READERS, os.cpu_count() or 1), thread_name_prefix="relit-calibrate") as pool:
        for result in pool.map(one, captures.lit):
            results.append(result)
            timings.advance(len(results))
    return leave_out_failures(captures, results, drop_failed=drop_failed)


def _targets(captures: LightCaptures) -> dict[int, SingleLight]:
    """Return the light of each measured frame as the target's manifest has it now, by the frame's number in the source."""
    return {lit.number: own.light for lit, own in zip(captures.lit, lit_frames(captures.target), strict=True)}


def _scaled(results: Sequence[MeasuredLight], albedo: tuple[float, float, float] | None) -> list[MeasuredLight]:
    """Divide ρ/π · irradiance by the ball's albedo / π, or scale it so that the mean over lights and channels is 1."""
    scales = np.array([result.entry["scale"] for result in results if result.light is not None])
    factor = np.full(3, 1 / scales.mean()) if albedo is None else np.pi / np.array(albedo)
    scaled = []
    for result in results:
        if result.light is not None:
            rgb = np.array(result.entry["scale"]) * factor
            name = "irradiance" if isinstance(result.light, DistantLight) else "intensity"
            entry = {name: digits(rgb), **{key: value for key, value in result.entry.items() if key != "scale"}}
            scaled.append(MeasuredLight(with_brightness(result.light, rgb), entry, (three_numbers(rgb), f"{result.entry['residual']:.3f}"),
                                   result.doubt))
        else:
            scaled.append(result)
    return scaled


def _contradicting(found: Intensities) -> np.ndarray:
    """Return which lights contradict the others, [lights] bool: beside readings of their own, and beside those of all (dim lights have
    noise)."""
    left = found.residual.max(axis=1)
    far = [each > ALIEN * np.nanmedian(each) for each in (left, left * found.irradiance.max(axis=1))]
    return np.asarray((left > LEAST_ALIEN) & far[0] & far[1])


def intensity(request: IntensityRequest, progress: Progress | None = None) -> LightCalibration:
    """Measure the irradiance of each light of known direction from images of a mostly Lambertian object; the mean is 1."""
    captures, timings = open_captures(request, progress)
    source = captures.source
    for lit in captures.lit:
        if not isinstance(lit.light, DistantLight):
            raise ManifestError(f"{source.folder / FILE_NAME}: frames[{lit.number}].light: is {lit.light.type}: "
                                "intensity is for distant lights of known direction")
    directions = np.array([lit.light.direction for lit in captures.lit if isinstance(lit.light, DistantLight)])
    try:
        check_directions(directions)
    except CalibrationError as error:
        raise CalibrationError(f"{source.folder / FILE_NAME}: frames: {error}") from error
    inside = np.flatnonzero(source.mask())
    chosen = np.random.default_rng(0).choice(inside, min(request.pixels, len(inside)), replace=False)
    correction = Correction.of(source, full_scale=True)
    timings.stage("frames", len(captures.lit))
    readings, usable = np.empty((len(captures.lit), len(chosen), 3)), np.ones((len(captures.lit), len(chosen)), dtype=bool)
    for number, lit in enumerate(captures.lit):
        radiance = correction.apply(lit.frame)
        readings[number] = radiance.pixels.reshape(-1, 3)[chosen]
        if radiance.saturated is not None:
            usable[number] = ~radiance.saturated.reshape(-1)[chosen]
        timings.advance(number + 1)
    timings.stage("fit", 1)
    try:
        found = fit_intensities(readings, usable, directions)
        elsewhere = light_from_elsewhere(readings, usable, directions, found.irradiance)
        uncertainty = uncertainty_of(readings, usable, directions, found.irradiance, elsewhere)
    except CalibrationError as error:
        raise CalibrationError(f"{source.folder}: {error}") from error
    alien = _contradicting(found)
    uncertainty[alien] = 1.0
    results: list[MeasuredLight | CalibrationError] = []
    for lit, rgb, residual, sigma, other in zip(captures.lit, found.irradiance, found.residual, uncertainty, alien, strict=True):
        assert isinstance(lit.light, DistantLight)
        if np.isnan(rgb).any():
            results.append(CalibrationError("too few pixels of the object are lit by this light to tell its brightness"))
            continue
        flags = ["behind: seen at grazing angles only"] if lit.light.direction[2] < BEHIND_Z else []
        flags += ["contradicts the others: check its direction and image"] if other else []
        entry = {"irradiance": digits(rgb), "uncertainty": digits(sigma), "residual": digits(residual), "flags": flags}
        row = (three_numbers(rgb), f"{100 * sigma.max():.2g} %", f"{residual.max():.3f}")
        results.append(MeasuredLight(with_brightness(lit.light, rgb), entry, row, float(sigma.max())))
    timings.close()
    measured = leave_out_failures(captures, results, drop_failed=request.drop_failed)
    wrong = ", ".join(lit.frame.image for lit, other in zip(captures.lit, alien, strict=True) if other)
    unsure = float(np.median([result.doubt for result in measured if result.light is not None]))
    warnings: tuple[str, ...] = () if unsure < UNSURE else (
        f"lights: parts of the object ask for lights that differ by {100 * unsure:.0f} %, as where it is glossy, rough, velvet or metal, "
        "or in shadow: measure them on a grey ball (relit calibrate grey-ball)",)
    if elsewhere.max() > ROOM_LIGHT:
        warnings = (*warnings, f"frames: surfaces have {100 * elsewhere.max():.0f} % of the light of a mean lamp from elsewhere, from the "
                               "room, other surfaces or a dark level of the camera, which makes dim lamps too bright: add a frame of type "
                               "off, or a dark image")
    if wrong:
        warnings = (*warnings, f"frames: {wrong}: readings contradict those under the other lights, as where an image is that of another "
                               "light, or clipped, or light.direction is wrong: their strength is not known")
    return write_lights("intensity", request, captures, measured, headings=("irradiance", "sure to", "residual"),
                        summary={"pixels": found.pixels}, relative=True, warnings=warnings)
