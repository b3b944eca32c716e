"""What measured lights show that they should not: spots that are wider than the others, two lamps at one place, balls whose readings are
clipped or that another light lit than the declared one, and reflections that meet nowhere."""

from collections.abc import Sequence

import numpy as np

from service.calibrate.results import LightCaptures, MeasuredLight
from service.calibrate.solvers.mirror_ball import MISSES
from service.calibrate.solvers.saturation_level import clipped_level
from service.light_estimation.ball import Ball, BallView
from service.light_estimation.grey_ball import fit_direction
from service.light_estimation.lambertian import degrees_between
from stage.capture.light import DistantLight, PointLight
from stage.errors import CalibrationError

WIDE = 2.0
"""The size of the spot of a lamp over the median of all, from which something beside the lamp may be a part of it."""
ONE_PLACE = 0.25, 0.1
"""How near two lamps are for one to stand for both: relative to the size of a spot, of which a disc is 0.7 radii, so that lamps beside each
other are 2.8 apart; and to the uncertainty of a position, which is mostly that of the ball and shared by both."""
ONE_SPOT_PX = 0.25
"""How near the spots of two distant lamps are for one to stand for both: that of one lamp comes back to 0.03 px under noise and JPEG. Of a
soft box that is held by hand, spots are so large that two places of thirty are often near by their size."""
BESIDE_DEGREES, BESIDE_SIGMAS = 5.0, 3.0
"""Angle between the direction that the shading of a ball asks for and the declared one, from which on it is said: light of the room of 15 %
turns it by 8° at a standard error of 1.5°, gloss and rough surfaces by their standard error."""
ALIEN, LEAST_ALIEN = 5.0, 0.02
"""Residual of a light, over the median of all and relative to readings, from which it contradicts the others; 2 where none does."""
LEAST_CLIPPED = 0.005
"""Part of the pixels of a ball that are clipped from which on it is said: a smaller one is 0 % in words."""
NAMED = 5
"""The most frames that a sentence names."""


def with_wide_spots(results: Sequence[MeasuredLight]) -> list[MeasuredLight]:
    """Return lights measured on a mirror ball, as unsure as their spot is wide where it is wider than those of the other lights: what
    stands beside a lamp and mirrors it may be a part of such a spot."""
    sizes = [result.entry["spot_degrees"] for result in results if result.light is not None]
    held = []
    for result in results:
        if result.light is not None and result.entry["spot_degrees"] > WIDE * float(np.median(sizes)):
            doubt = float(np.hypot(result.doubt, result.entry["spot_degrees"]))
            entry = {**result.entry, "uncertainty_degrees": round(doubt, 4), "flags": [*result.entry["flags"], "wider than the others"]}
            result = result._replace(entry=entry, row=(result.row[0], f"{doubt:.2f}°", *result.row[2:]), doubt=doubt)
        held.append(result)
    return held


def at_one_place(captures: LightCaptures, results: Sequence[MeasuredLight]) -> list[str]:
    """Return a sentence on frames whose lamp stands where that of an earlier frame does; none where half of all do, as where a lamp has
    several colours. Frames of another exposure or polarisation are no such."""
    pairs = []
    for number, later in enumerate(captures.lit):
        for earlier, one in zip(captures.lit[:number], results, strict=False):
            alike = earlier.frame.exposure_s == later.frame.exposure_s and earlier.light.polarization == later.light.polarization
            if alike and _one_place(one, results[number]):
                pairs.append(f"{later.frame.image} as {earlier.frame.image}")
                break
    if not 0 < 2 * len(pairs) < len(results):
        return []
    return [f"frames: the lamp stands at one place in {_listed(pairs)}: one image is a copy of the other, or the lamp did not change; the "
            "light of one of them is wrong"]


def _one_place(one: MeasuredLight, other: MeasuredLight) -> bool:
    spot, sure = ONE_PLACE
    if isinstance(one.light, DistantLight) and isinstance(other.light, DistantLight):
        apart = float(degrees_between(np.array(one.light.direction), np.array(other.light.direction)))
        away_px = np.linalg.norm(np.subtract(one.entry["spot_uv"], other.entry["spot_uv"]))
        return bool(apart < spot * min(one.entry["spot_degrees"], other.entry["spot_degrees"]) and away_px < ONE_SPOT_PX)
    if isinstance(one.light, PointLight) and isinstance(other.light, PointLight):
        away = np.linalg.norm(np.subtract(one.light.position_m, other.light.position_m))
        return bool(away < sure * min(one.doubt, other.doubt))
    return False


def _listed(words: Sequence[str]) -> str:
    more = f" and {len(words) - NAMED} more" if len(words) > NAMED else ""
    return ", ".join(words[:NAMED]) + more


def with_clipped(radiance: np.ndarray, saturated: np.ndarray | None, view: BallView) -> tuple[np.ndarray | None, list[str]]:
    """Return which pixels of a grey ball are saturated, [h, w] bool or None, those too at which its readings pile up below the declared
    saturation, and a flag where there are any. `radiance`: [h, w, 3] linear, the box of `view`. `saturated`: as declared, or None."""
    level = clipped_level(radiance[view.inside])
    if np.isfinite(level):
        clipped = np.asarray((radiance >= level).any(axis=-1))
        saturated = clipped if saturated is None else np.asarray(saturated | clipped)
    share = 0.0 if saturated is None else float(saturated[view.inside].mean())
    return saturated, [f"clipped at {100 * share:.0f} % of the ball"] if share >= LEAST_CLIPPED else []


def beside(radiance: np.ndarray, saturated: np.ndarray | None, light: DistantLight | PointLight, ball: Ball, view: BallView
           ) -> dict[str, float]:
    """Return for the report by how many degrees the shading of a grey ball asks for another direction than that of its distant light, and
    how sure that is; nothing where shading does not tell."""
    if not isinstance(light, DistantLight):
        return {}
    try:
        shading = fit_direction(radiance, saturated, view)
    except CalibrationError:  # too little of the lit side is seen
        return {}
    sure = float(np.hypot(shading.uncertainty_degrees, np.degrees(ball.outline_error_px / ball.radius_px)))
    return {"beside_degrees": round(float(degrees_between(shading.direction, np.array(light.direction))), 3),
            "beside_sure_to_degrees": round(sure, 3)}


def with_beside(captures: LightCaptures, results: Sequence[MeasuredLight]) -> tuple[list[MeasuredLight], list[str]]:
    """Return lights measured on a grey ball, flagged where they stand beside their direction, and a sentence on their frames if there are
    any."""
    left = [result.entry["residual"] for result in results if result.light is not None]
    flagged: list[MeasuredLight] = []
    names: list[str] = []
    most = 0.0
    for lit, result in zip(captures.lit, results, strict=True):
        apart = result.entry.get("beside_degrees", 0.0)
        misfit = result.entry.get("residual", 0.0)
        least = 0.0 if misfit > max(ALIEN * float(np.median(left)), LEAST_ALIEN) else BESIDE_DEGREES
        if apart > least + BESIDE_SIGMAS * result.entry.get("beside_sure_to_degrees", 0.0):
            result = result._replace(entry={**result.entry, "flags": [*result.entry["flags"],
                                                                      f"lit from {apart:.0f}° beside its direction"]})
            names, most = [*names, lit.frame.image], max(most, float(apart))
        flagged.append(result)
    return flagged, [] if not names else [
        f"frames: {_listed(names)}: the shading of the ball says that the light stands up to {most:.0f}° from its light.direction: check "
        "that each image is that of its light, and the axes of the directions; its irradiance is not known"]


def as_unsure_as_rays_miss(results: Sequence[MeasuredLight]) -> list[MeasuredLight]:
    """Return near lights, as unsure as the rays of all of them miss each other beyond their uncertainty, as where balls are not as large or
    not where they are said to be, which all lights share."""
    factor = max(float(np.sqrt(np.mean([result.entry["excess"] for result in results if result.light is not None]))), 1.0)
    held = []
    for result in results:
        if result.light is not None:
            doubt = factor * result.doubt
            entry = {**result.entry, "uncertainty_m": float(f"{doubt:.3g}")}
            result = result._replace(entry=entry, row=(result.row[0], f"{doubt:.2g} m", *result.row[2:]), doubt=doubt)
        held.append(result)
    return held


def missing_sentence(results: Sequence[MeasuredLight]) -> list[str]:
    """Return a sentence where the reflections in mirror balls do not meet in most frames."""
    missed = sum(MISSES in result.entry["flags"] for result in results)
    if 2 * missed <= len(results):
        return []
    return [f"the reflections in the balls do not meet in {missed} of {len(results)} frames: check the radii (--ball-radius-m, in the "
            "order of the balls), camera.focal_px or pixel_size_m, and that no ball moved"]
