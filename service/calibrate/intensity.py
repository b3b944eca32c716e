"""Calibration of the brightness of lights of known direction, from images of the object."""

import numpy as np

from service.calibrate.results import (
    LightCalibration,
    MeasuredLight,
    digits,
    leave_out_failures,
    open_captures,
    three_numbers,
    write_lights,
)
from service.calibrate.solvers.apply import with_brightness
from service.light_estimation.semi_calibrated import check_directions, fit_intensities
from service.reporting.progress import Progress
from service.requests.calibrate import IntensityRequest
from stage.capture.light import DistantLight
from stage.capture.manifest import FILE_NAME
from stage.errors import CalibrationError, ManifestError
from stage.stack.correction import Correction

BEHIND_Z = -0.2
"""A light with z below this, more than 101° from the view axis, is flagged: the object shows it at grazing angles only."""


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
    correction = Correction.of(source)
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
    except CalibrationError as error:
        raise CalibrationError(f"{source.folder}: {error}") from error
    results: list[MeasuredLight | CalibrationError] = []
    for lit, rgb, residual, sigma in zip(captures.lit, found.irradiance, found.residual, found.uncertainty, strict=True):
        assert isinstance(lit.light, DistantLight)
        if np.isnan(rgb).any():
            results.append(CalibrationError("too few pixels of the object are lit by this light to tell its brightness"))
            continue
        flags = ["behind: seen at grazing angles only"] if lit.light.direction[2] < BEHIND_Z else []
        entry = {"irradiance": digits(rgb), "uncertainty": digits(sigma), "residual": digits(residual), "flags": flags}
        row = (three_numbers(rgb), f"{100 * sigma.max():.2g} %", f"{residual.max():.3f}")
        results.append(MeasuredLight(with_brightness(lit.light, rgb), entry, row, float(sigma.max())))
    timings.close()
    measured = leave_out_failures(captures, results, drop_failed=request.drop_failed)
    return write_lights("intensity", request, captures, measured, headings=("irradiance", "sure to", "residual"),
                        summary={"pixels": found.pixels}, relative=True)
