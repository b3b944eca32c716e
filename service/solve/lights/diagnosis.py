"""Faults of the manifest of a capture, found from what was solved with it: encoding, brightness, order and axes of the lights.

A wrong manifest seldom stops a solver: it finds normals that are wrong everywhere, and as sure as right ones. Every finding here is a
sentence that names the field, and raises the standard error of every normal by the angle that the finding asks for.
"""

from typing import Any

import numpy as np

from kernels.photometric.lambertian.readings import pad_lights
from kernels.photometric.model.samples import evenly
from service.light_estimation.explanations import PIXELS, Cause, Sample, better_explanation, explanation_sentence, fit_manifest
from service.solve.base.solution import PIXELS_AT_ONCE, Solution, SolveInput, raise_error, suspect_lights
from service.solve.lights.orientation import LightAxes, find_axes, find_inversion
from service.solve.lights.other_lights import find_other_lights
from stage.capture.capture import Capture
from stage.capture.gradients import GradientFrames
from stage.capture.lighting import ExtendedLights
from stage.capture.point_lights import DistantLights, PlacedLights

UNORDERED = (Cause.REVERSED, Cause.SHIFTED, Cause.DIRECTIONS)
"""Causes after which the normals say nothing about the axes."""
REPAIRED = "; the solve has used the brightness that the images ask for (found.light_intensities)"
FIELDS = {DistantLights: "frames[].light.direction", PlacedLights: "frames[].light.position_m",
          ExtendedLights: "frames[].light.directions", GradientFrames: "frames[].light.axis and sign"}
"""The field that holds the axes of each kind of lights; else they come from the reference ball."""


def diagnose(given: SolveInput, capture: Capture, lights: Any, declared: Any, solution: Solution) -> None:
    """Add a warning for everything that is wrong with the lights or the encoding, and make the normals less sure by it.
    `lights`: the lights with which the normals were solved; readings are examined under distant ones. `declared`: the lights of the
    manifest, which may have other intensities."""
    field = FIELDS.get(type(lights), "the capture of the reference ball")
    fit = None
    if isinstance(lights, DistantLights):
        assert isinstance(declared, DistantLights)
        solution.suspects = suspect_lights(solution, given.stack, pad_lights(declared.direction, declared.irradiance, given.stack.scale))
        sample = _sample(given, capture, declared)
        fit = fit_manifest(sample)
        found = better_explanation(sample, fit)
        estimated = lights is not declared
        if found is not None:
            repaired = estimated and found.cause in (Cause.IRRADIANCE, Cause.NORMALISED)
            solution.warnings.append(explanation_sentence(found, sample) + (REPAIRED if repaired else ""))
            if not repaired:
                raise_error(solution, found.degrees)
            if found.cause in UNORDERED:
                return
        other = find_other_lights(given, lights) if found is None or found.cause is Cause.IRRADIANCE else None
        if other is not None:
            solution.warnings.append(other.sentence)
            raise_error(solution, other.degrees)
        if estimated:
            fit = fit_manifest(sample._replace(irradiance=lights.irradiance))
    axes = find_axes(given, solution, lights if isinstance(lights, DistantLights) else None, fit)
    if axes is None:
        axes = find_inversion(given, solution, lights if isinstance(lights, DistantLights) else None)
    if axes is not None:
        solution.warnings.append(f"{field}: {axes.sentence}")
        if axes.degrees is not None:
            raise_error(solution, axes.degrees)
        elif axes.matrices:
            raise_error(solution, _turned_by(solution.normal, axes))


def _sample(given: SolveInput, capture: Capture, lights: DistantLights) -> Sample:
    stack = given.stack
    inside = np.flatnonzero(given.mask)
    radiance, usable = stack.pick_radiance(inside[evenly(len(inside), PIXELS)])
    times = {frame.image: frame.exposure_s or 1.0 for frame in capture.sources()}
    exposure = np.array([times[image] for image in stack.frames])
    return Sample(radiance, usable, lights.direction, lights.irradiance, exposure, capture.manifest.color_space)


def _turned_by(normal: np.ndarray, axes: LightAxes) -> np.ndarray:
    """Return the angle between each normal and its correction, degrees; of two possible corrections the root mean square."""
    squares = np.zeros(normal.shape[1], dtype=np.float32)
    for first in range(0, len(squares), PIXELS_AT_ONCE):
        part = normal[:, first : first + PIXELS_AT_ONCE]
        for matrix in axes.matrices:
            cosine = np.clip((part * (matrix.astype(np.float32) @ part)).sum(axis=0), -1, 1)
            squares[first : first + PIXELS_AT_ONCE] += np.degrees(np.arccos(cosine)) ** 2 / len(axes.matrices)
    return np.sqrt(squares)
