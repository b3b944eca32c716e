"""Calibration of a time-of-flight camera from a sweep over known distances: wiggling, scale, offset and drift."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.device import to_numpy
from kernels.tof.continuous.continuous import decode
from service.depth.tof.continuous_wave import estimate_noise
from service.depth.tof.tof import solve_tof, z_per_range
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import TofCalibrationRequest
from service.requests.depth import TofOptions
from stage.capture.capture import Capture
from stage.files import resolved
from stage.tof.calibration import (
    Harmonics,
    Sweep,
    SweepDistance,
    TofCalibration,
    fit_harmonics,
    fit_line,
    fit_temperature,
    read_sweep,
    write_calibration,
)
from stage.tof.raw_frames import is_pulsed, read_correlations, read_source
from stage.tof.source import SourcePath

STEP_PIXELS = 400
"""Pixels of each step, evenly chosen: more do not improve the harmonics, which the number of steps limits."""
SHARPEST_RAD = 0.3
"""Largest standard deviation of a phase that takes part in the fit, radians."""


class TofCalibrationResult(NamedTuple):
    """The calibration from a sweep, and its errors."""

    calibration: TofCalibration
    path: Path
    before_m: float
    """RMS of the steps' median errors without the calibration."""
    after_m: float
    """RMS of the same errors with the calibration that was made from them."""
    steps: int


def calibrate_tof(request: TofCalibrationRequest, progress: Progress | None = None, *,
                  allowed: Sequence[Path] | None = None) -> TofCalibrationResult:
    """Calibrate a time-of-flight camera, and write the calibration.
    `allowed`: folders of the captures that the sweep may name; None: any. Raises StageError or KernelError if a capture or the sweep cannot
    be used, or does not determine the calibration; nothing is written. Raises RequestError if steps of both kinds, a step without a solved
    pixel, or a capture that is not allowed."""
    timings = Timings(progress)
    device, sweep = devices.resolve(request.device), request.sweep
    plan = read_sweep(sweep)
    captures = [Capture.open(_folder(sweep, step, allowed)) for step in plan.steps]
    kinds = {is_pulsed(capture) for capture in captures}
    if len(kinds) > 1:
        raise RequestError(f"{sweep}: steps: some are cw and some pulsed: give a sweep for each")
    plain = _range_errors(plan, captures, None, device, timings)
    if kinds == {True}:
        known: dict[str, Any] = _scale_and_offset(plan, captures, plain)
    else:
        known = _harmonics(plan, captures, device, timings)
    calibration = TofCalibration.model_validate(known)
    after = _range_errors(plan, captures, calibration, device, timings)
    if plan.has_drift:
        warm = np.array([step.temperature_c for step in plan.steps], dtype=np.float64)
        drift, level = fit_temperature(after, warm)
        calibration = TofCalibration.model_validate({**known, "temperature": drift, "offset_m": calibration.offset_m + level})
        after = after - level - drift.metres_per_c * (warm - drift.reference_c)
    write_calibration(calibration, request.out)
    timings.close()
    before_m, after_m = (float(np.sqrt(np.mean(errors**2))) for errors in (plain, after))
    return TofCalibrationResult(calibration, request.out, before_m, after_m, len(plan.steps))


def _folder(sweep: Path, step: SweepDistance, allowed: Sequence[Path] | None) -> Path:
    folder = sweep.parent / step.capture
    if allowed is None:
        return folder
    place = resolved(folder)
    found = next((each for each in allowed if each.resolve() == place), None)
    if found is None:
        raise RequestError(f"{sweep}: steps: {step.capture!r} is none of the captures that lie beside one another in its folder")
    return found


def _range_errors(plan: Sweep, captures: list[Capture], calibration: TofCalibration | None, device: str, timings: Timings) -> np.ndarray:
    """Return [steps] the median of measured less true half path of light, metres."""
    errors = []
    for step, capture in zip(plan.steps, captures, strict=True):
        solved = solve_tof(capture, TofOptions(), calibration=calibration, device=device, timings=timings)
        if not solved.solved.any() or solved.range_m is None:
            raise RequestError(f"{capture.folder}: no pixel of this step is solved: check its frames and its mask")
        off = _half_path(solved.range_m.astype(np.float64), capture) - _true_half_path(step, capture)
        errors.append(float(np.median(off[solved.solved])))
    return np.array(errors)


def _true_half_path(step: SweepDistance, capture: Capture) -> np.ndarray:
    """Return [rows, cols] half the path of light by way of the target; with the source at the camera, the range along each ray."""
    return _half_path(step.depth_m / z_per_range(capture.camera), capture)


def _half_path(range_m: np.ndarray, capture: Capture) -> np.ndarray:
    path = SourcePath.of(capture.camera, read_source(capture))
    return range_m if path is None else path.half_path_m(range_m)


def _scale_and_offset(plan: Sweep, captures: list[Capture], errors: np.ndarray) -> dict[str, Any]:
    """Return scale and offset, fitted to the median half paths of the steps."""
    true = np.array([float(np.median(_true_half_path(step, capture)[capture.mask()]))
                     for step, capture in zip(plan.steps, captures, strict=True)])
    scale, offset = fit_line(true + errors, true)
    return {"scale": scale, "offset_m": offset}


def _harmonics(plan: Sweep, captures: list[Capture], device: str, timings: Timings) -> dict[str, Any]:
    """Return the harmonics of each frequency, fitted to the steps at the commonest temperature."""
    chosen = [(step, capture) for step, capture in zip(plan.steps, captures, strict=True)
              if step.temperature_c == plan.commonest_temperature_c]
    timings.stage("wiggling", len(chosen))
    phases: dict[float, list[np.ndarray]] = {}
    ranges: dict[float, list[np.ndarray]] = {}
    for done, (step, capture) in enumerate(chosen, start=1):
        frames = read_correlations(capture)
        inside = np.nonzero(capture.mask().reshape(-1))[0]
        some = inside[np.linspace(0, len(inside) - 1, min(STEP_PIXELS, len(inside))).astype(int)]
        noise = estimate_noise(frames.images, frames.modulation_hz, frames.reference_phase_rad, cols=capture.camera.width,
                               scale=frames.scale)
        found = decode(frames.images, frames.modulation_hz, frames.reference_phase_rad, noise=noise,
                       saturation=capture.manifest.saturation, scale=frames.scale, device=device)
        true = _true_half_path(step, capture).reshape(-1)[some]
        phase, sigma = to_numpy(found.phase)[:, some], to_numpy(found.sigma)[:, some]
        for row, hz in enumerate(found.modulation_hz.tolist()):
            good = (sigma[row] > 0) & (sigma[row] < SHARPEST_RAD)
            phases.setdefault(hz, []).append(phase[row, good].astype(np.float64))
            ranges.setdefault(hz, []).append(true[good])
        timings.advance(done)
    tables: list[Harmonics] = [fit_harmonics(np.concatenate(phases[hz]), np.concatenate(ranges[hz]), hz) for hz in phases]
    return {"harmonics": tuple(tables)}
