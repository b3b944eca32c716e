"""Faults of the manifest of a capture, found from what was solved with it: encoding, brightness, order and axes of the lights.

A wrong manifest seldom stops a solver: it finds normals that are wrong everywhere, and as sure as right ones. Every finding here is a
sentence that names the field, and raises the standard error of every normal by the angle that the finding asks for.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from kernels.photometric.lambertian.readings import pad_lights
from kernels.status import ESTIMATED
from service.light_estimation.declared_lights import explanation_sentence, sample_of, sampled
from service.light_estimation.explanations import Cause, Sample, better_explanation, fit_manifest
from service.light_estimation.lambertian import degrees_between
from service.light_estimation.light_axes import LightAxes
from service.light_estimation.lit_object import lit_object
from service.solve.base.solution import PIXELS_AT_ONCE, Solution, SolveInput, at_all_pixels, raise_error, suspect_lights
from service.solve.lights.adapted import find_adapted
from service.solve.lights.intensities import LEAST_GAIN as LEAST_ASKED
from service.solve.lights.orientation import find_axes, find_inversion
from service.solve.lights.other_lights import OtherLights, Rig
from service.solve.lights.placement import find_placement
from service.solve.lights.turn import find_turn
from stage.capture.capture import Capture
from stage.capture.gradients import GradientFrames
from stage.capture.lighting import ExtendedLights
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.colour.colour_spaces import is_linear

FILLS = 0.9
"""Part of an image above which an object fills it, and no dark background hides from the sample what is wrong."""
UNORDERED = (Cause.REVERSED, Cause.TEXT, Cause.SHIFTED, Cause.BALL_NORMALS, Cause.ELEVATION, Cause.DIRECTIONS)
"""Causes after which the normals say nothing about the axes."""
REPAIRED = "; the solve has used the brightness that the images ask for (found.light_intensities)"
FIELDS = {DistantLights: "frames[].light.direction", PlacedLights: "frames[].light.position_m",
          ExtendedLights: "frames[].light.directions", GradientFrames: "frames[].light.axis and sign"}
"""The field that holds the axes of each kind of lights; else they come from the reference ball."""


def diagnose(given: SolveInput, capture: Capture, lights: Any, declared: Any, solution: Solution, other: OtherLights | None,
             rig: Rig | None) -> None:
    """Add a warning for everything that is wrong with the lights or the encoding, and make the normals less sure by it.
    `lights`: the lights with which the normals were solved; readings are examined under distant ones. `declared`: the lights of the
    manifest, which may have other intensities. `other`: lights that explain the images much better. `rig`: they as the solve has taken
    them."""
    field = FIELDS.get(type(lights), "the capture of the reference ball")
    if given.mask.all():
        seen = lit_object(solution.albedo.astype(np.float32).mean(axis=0).reshape(given.mask.shape))
        given = replace(given, mask=seen) if 0 < seen.mean() < FILLS else given
    fit = None
    if isinstance(lights, DistantLights):
        assert isinstance(declared, DistantLights)
        solution.suspects = suspect_lights(solution, given.stack, pad_lights(declared.direction, declared.irradiance, given.stack.scale))
        sample = sample_of(given.stack, capture, declared, given.mask)
        fit = fit_manifest(sample)
        found = better_explanation(sample, fit)
        estimated = lights is not declared
        if found is not None:
            repaired = estimated and found.cause in (Cause.IRRADIANCE, Cause.STEP, Cause.NORMALISED)
            solution.warnings.append(explanation_sentence(found, sample) + (REPAIRED if repaired else ""))
            if found.normal is not None:
                _raise_to(given, solution, found.normal)
            elif not repaired:
                raise_error(solution, found.degrees)
            if found.cause in UNORDERED:
                return
        asked = estimated or solution.facts.get("light_intensities", {}).get("left_out_gain", 0.0) >= LEAST_ASKED
        if asked and not is_linear(capture.manifest.color_space):
            _hold_adapted(given, sample, solution)
        if found is not None and found.cause not in (Cause.IRRADIANCE, Cause.STEP) and rig is None:
            other = None
        if other is not None and (other.sentence is not None or solution.specular is None):  # else lobes have been fitted
            raise_error(solution, other.degrees if rig is None else rig.degrees)
        sentence = None if other is None else other.sentence if rig is None else rig.sentence
        if sentence is None:
            other = None
        else:
            solution.warnings.append(sentence)
        if estimated:
            fit = fit_manifest(sample._replace(irradiance=lights.irradiance))
    moved = find_placement(given, lights) if isinstance(lights, PlacedLights) else None
    if moved is not None:
        solution.warnings.append(moved.sentence)
        solution.facts["light_placement"] = moved.facts
        raise_error(solution, moved.degrees)
    axes = find_axes(given, solution, lights if isinstance(lights, DistantLights) else None, fit)
    if axes is None:
        axes = find_inversion(given, solution, lights if isinstance(lights, DistantLights) else None)
    if axes is not None:
        solution.warnings.append(f"{field}: {axes.sentence}")
        if axes.degrees is not None:
            raise_error(solution, axes.degrees)
        elif axes.matrices:
            raise_error(solution, _turned_by(solution.normal, axes))
        return
    aimed = lights if rig is None else rig.lights
    if isinstance(aimed, DistantLights | PlacedLights) and (other is None or rig is not None) and moved is None:
        turn = find_turn(given, aimed, solution)
        if turn is not None:
            solution.warnings.append(
                f"{field}: all lights look turned {turn.words()}: turned back, slopes or highlights fit what the images show; check that "
                "the camera looks along the axis of the table, and that no light of the room is in the images, or take them as found "
                "(--lights refined); sigma holds the error that this makes")
            solution.facts["light_turn"] = turn.facts()
            raise_error(solution, turn.error(solution.normal))


def _hold_adapted(given: SolveInput, sample: Sample, solution: Solution) -> None:
    """Make normals less sure by what they would be if the images were adapted in brightness from place to place."""
    adapted = find_adapted(sample, np.stack(np.divmod(sampled(given.mask), given.mask.shape[1]), axis=1))
    if adapted is None:
        return
    turned = _raise_to(given, solution, adapted.fit.normal)
    solution.warnings.append("images: they may be adapted in brightness from place to place, as by HDR or local contrast of a phone, in "
                             f"place of lights of other strengths, which turns normals by {turned:.2g}°: give images without; "
                             "sigma holds that")


def _raise_to(given: SolveInput, solution: Solution, normal: np.ndarray) -> float:
    """Add to σ how far normals are from what they may be, [3, pixels] at those of the sample, and return the median of these angles."""
    chosen = sampled(given.mask)
    told = np.isin(solution.status[chosen], ESTIMATED)
    if not told.any():
        return 0.0
    turned = degrees_between(solution.normal[:, chosen], normal)[told]
    raise_error(solution, at_all_pixels(given.mask, chosen[told], turned))
    return float(np.median(turned))


def _turned_by(normal: np.ndarray, axes: LightAxes) -> np.ndarray:
    """Return the angle between each normal and its correction, degrees; of two possible corrections the root mean square."""
    squares = np.zeros(normal.shape[1], dtype=np.float32)
    for first in range(0, len(squares), PIXELS_AT_ONCE):
        part = normal[:, first : first + PIXELS_AT_ONCE]
        for matrix in axes.matrices:
            cosine = np.clip((part * (matrix.astype(np.float32) @ part)).sum(axis=0), -1, 1)
            squares[first : first + PIXELS_AT_ONCE] += np.degrees(np.arccos(cosine)) ** 2 / len(axes.matrices)
    return np.sqrt(squares)
