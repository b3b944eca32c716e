"""Calibration of a time-of-flight camera from a sweep over known distances: wiggling, scale, offset and drift, how far they are known, and
what the sweep says of its own distances."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

from kernels import device as devices
from kernels.device import to_numpy
from kernels.photometric.model.samples import evenly
from kernels.tof.continuous.continuous import decode
from kernels.tof.continuous.modulation import common_range_m
from service.calibrate.results import digits, write_report
from service.calibrate.solvers.tof_sweep import (
    Fit,
    StepPhases,
    all_readings,
    contradicting,
    fit_steps,
    fit_wiggling,
    of_target,
    part_at,
    target_faults,
    wiggling_sigma,
)
from service.depth.tof.continuous_wave import estimate_noise
from service.depth.tof.tof import solve_tof, z_per_range
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import TofCalibrationRequest
from service.requests.depth import TofOptions
from stage.capture.capture import Capture
from stage.capture.light import ContinuousWave
from stage.errors import CalibrationError
from stage.files import resolved
from stage.spread import MAD_TO_SIGMA
from stage.tof.calibration import (
    Sweep,
    SweepDistance,
    TofCalibration,
    fit_harmonics,
    fit_line,
    fit_temperature,
    read_sweep,
    write_calibration,
)
from stage.tof.light_time import SPEED_OF_LIGHT
from stage.tof.raw_frames import is_pulsed, read_correlations, read_source
from stage.tof.source import SourcePath

STEP_PIXELS = 400
"""Pixels of each step, evenly chosen: more do not improve the harmonics, which the number of steps limits."""
SHARPEST_RAD = 0.3
"""Largest standard deviation of a phase that takes part in the fit, radians."""
MOST_SCATTER = 0.15
"""Scatter of the errors of ranges, as a part of what the highest frequency tells apart, beyond which no wiggling makes them."""
MOST_WRONG = 0.2
"""Largest part of the steps that is left out."""
LEAST_OFF_PLANE, LEAST_SEEN = 0.02, 0.03
"""Part of the readings off the plane of the target from which on they are said, of which noise leaves a thousandth; and least part of the
pixels of a step at its distance that is a target: other things pass all distances by less."""
MOST_REPEATS = 10
"""Distances in ranges after which phases repeat beyond which pixels are at any distance by chance: they are in another unit."""
FALLING = 0.8
"""Length of the mean phasor of the sums of measured and true ranges from which on they are one sum; by chance 0.2 of 25 steps."""
FEWEST = 5
"""Fewest steps of which one can contradict the others."""
DETERMINED = 0.5
"""Standard deviation of ranges, as a part of their errors without a calibration, above which more distances are needed."""
MOST_SCALED = 0.05
"""Part by which measured distances are wrong beside declared ones beyond which no clock of a camera makes them; crystals keep 10⁻⁴."""
APART = 0.1
"""Part of the spread of distances that does not follow the temperature, below which drift and scale are one."""


class TofCalibrationResult(NamedTuple):
    """The calibration from a sweep, and its errors."""

    calibration: TofCalibration
    path: Path
    report_path: Path
    before_m: float
    """RMS of the steps' median errors without the calibration."""
    after_m: float
    """RMS of the same errors with the calibration that was made from them."""
    steps: int
    """The number of steps that were used."""
    warnings: tuple[str, ...]


def calibrate_tof(request: TofCalibrationRequest, progress: Progress | None = None, *,
                  allowed: Sequence[Path] | None = None) -> TofCalibrationResult:
    """Calibrate a time-of-flight camera, and write the calibration, with calibration.json beside it.
    `allowed`: folders of the captures that the sweep may name; None: any. Raises StageError or KernelError if a capture or the sweep cannot
    be used, or does not determine the calibration; nothing is written. Raises RequestError if steps of both kinds, a step without a solved
    pixel, distances that are not those of the captures, or a capture that is not allowed."""
    timings = Timings(progress)
    device, sweep = devices.resolve(request.device), request.sweep
    plan = read_sweep(sweep)
    captures = [Capture.open(_folder(sweep, step, allowed)) for step in plan.steps]
    kinds = {is_pulsed(capture) for capture in captures}
    if len(kinds) > 1:
        raise RequestError(f"{sweep}: steps: some are cw and some pulsed: give a sweep for each")
    measured = _range_errors(plan, captures, None, device, timings)
    pulsed, plain = kinds == {True}, measured.errors
    found = _fit_line(plan, captures, measured) if pulsed else _fit_wiggling(plan, captures, measured, device, timings)
    calibration = TofCalibration.model_validate({
        **found.known, "sigma_m": None if found.sigma_m is None else float(f"{found.sigma_m:.3g}")})
    after = _range_errors(plan, captures, calibration, device, timings, told=found.warnings).errors
    used = np.isin(np.arange(len(captures)), found.left_out, invert=True)
    if plan.has_drift:
        warm = np.array([step.temperature_c for step in plan.steps], dtype=np.float64)
        drift, level = fit_temperature(after[used], warm[used])
        after = after - level - drift.metres_per_c * (warm - drift.reference_c)
        own = 0.0 if pulsed else after[used].std(ddof=1)  # the line was fitted beside the drift
        sigma = None if found.sigma_m is None else float(f"{np.hypot(found.sigma_m, own):.3g}")
        calibration = calibration.model_copy(update={"temperature": drift, "offset_m": calibration.offset_m + level, "sigma_m": sigma})
    write_calibration(calibration, request.out)
    report = write_report("tof", request, request.out.parent, {
        "steps": [{"capture": step.capture, "depth_m": step.depth_m, "error_m": error, "used": bool(kept)}
                  for step, error, kept in zip(plan.steps, digits(after), used, strict=True)],
        "sigma_m": calibration.sigma_m, "warnings": list(found.warnings)})
    timings.close()
    before_m, after_m = (float(np.sqrt(np.mean(errors[used] ** 2))) for errors in (plain, after))
    return TofCalibrationResult(calibration, request.out, report, before_m, after_m, int(used.sum()), found.warnings)


def _folder(sweep: Path, step: SweepDistance, allowed: Sequence[Path] | None) -> Path:
    folder = sweep.parent / step.capture
    if allowed is None:
        return folder
    place = resolved(folder)
    found = next((each for each in allowed if each.resolve() == place), None)
    if found is None:
        raise RequestError(f"{sweep}: steps: {step.capture!r} is none of the captures that lie beside one another in its folder")
    return found


class _Measured(NamedTuple):
    """Measured less true half paths of light, metres."""

    errors: np.ndarray  # [steps] the median of each step
    true: np.ndarray  # [steps] the median true half path of the same pixels
    some: list[np.ndarray]  # of each step, of some of its pixels
    repeat_m: float | None
    """Range after which all phases repeat, so that errors are known but for multiples of it; None of pulses."""

    @property
    def falls(self) -> bool:
        """Return whether the measured ranges fall by as much as the true ones grow."""
        return self.repeat_m is not None and abs(np.exp(2j * np.pi / self.repeat_m * (self.errors + 2 * self.true)).mean()) > FALLING

    def others(self, near_m: float) -> str:
        """Return a sentence if less than half of most pictures lies where their distance says, and some of nearly each does, within
        `near_m`; else nothing."""
        if self.repeat_m is not None and np.median(self.true) > MOST_REPEATS * self.repeat_m:
            return ""
        part = part_at(self.some, near_m, self.repeat_m)
        if (part >= LEAST_SEEN).mean() < 1 - MOST_WRONG or (part >= 0.5).mean() >= 1 - MOST_WRONG:
            return ""
        return (f"steps: {np.median(part):.0%} of the pixels of a step lie at its depth_m, and most of the others elsewhere: give each "
                "capture a mask of the target alone, and check depth_m")


def _range_errors(plan: Sweep, captures: list[Capture], calibration: TofCalibration | None, device: str, timings: Timings, *,
                  told: tuple[str, ...] = ()) -> _Measured:
    """Return by how much measured half paths of light differ from true ones. `told`: what is known to be wrong with the sweep."""
    errors, true, some, hz = list[float](), list[float](), list[np.ndarray](), set[float]()
    for step, capture in zip(plan.steps, captures, strict=True):
        solved = solve_tof(capture, TofOptions(), calibration=calibration, device=device, timings=timings)
        if not solved.solved.any() or solved.range_m is None:
            given = "" if calibration is None else " with the calibration that the distances give"
            raise RequestError(f"{capture.folder}: no pixel of this step is solved{given}: "
                               f"{'; '.join(told or solved.warnings) or 'check its frames and its mask'}")
        right = _true_half_path(step, capture)[solved.solved]
        true.append(float(np.median(right)))
        off = _half_path(solved.range_m.astype(np.float64), capture)[solved.solved] - right
        errors.append(float(np.median(off)))
        some.append(off[evenly(len(off), STEP_PIXELS)])
        hz |= {frame.tof.modulation_hz for frame in capture.manifest.frames if isinstance(frame.tof, ContinuousWave)}
    repeat_m, found = common_range_m(sorted(hz), SPEED_OF_LIGHT) if hz else None, np.array(errors)
    if repeat_m is not None:  # a target beyond what the frequencies tell apart is as good as another
        usual = float(np.angle(np.exp(2j * np.pi / repeat_m * found).sum())) / (2 * np.pi) * repeat_m
        found -= repeat_m * np.round((found - usual) / repeat_m)
    return _Measured(found, np.array(true), some, repeat_m)


def _true_half_path(step: SweepDistance, capture: Capture) -> np.ndarray:
    """Return [rows, cols] half the path of light by way of the target; with the source at the camera, the range along each ray."""
    return _half_path(step.depth_m / z_per_range(capture.camera), capture)


def _half_path(range_m: np.ndarray, capture: Capture) -> np.ndarray:
    path = SourcePath.of(capture.camera, read_source(capture))
    return range_m if path is None else path.half_path_m(range_m)


class _Found(NamedTuple):
    """What a sweep gives."""

    known: dict[str, Any]
    """Entries of the calibration."""
    sigma_m: float | None
    """The standard deviation of ranges that it leaves open; of harmonics before a drift with temperature. None: the steps are too few to
    tell."""
    left_out: list[int]
    """The steps whose distances contradict the others."""
    warnings: tuple[str, ...]


def _fit_line(plan: Sweep, captures: list[Capture], found: _Measured) -> _Found:
    """Fit scale and offset to the median half paths of the steps, beside a drift with their temperatures."""
    errors = found.errors
    true = np.array([float(np.median(_true_half_path(step, capture)[capture.mask()]))
                     for step, capture in zip(plan.steps, captures, strict=True)])
    measured = true + errors
    warm = np.array([step.temperature_c if plan.has_drift else 0.0 for step in plan.steps], np.float64)

    def off(steps: list[int]) -> Fit:
        return fit_steps([np.array([[measured[step], 1.0, warm[step]]]) for step in steps], [true[step:step + 1] for step in steps])

    def beside(values: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return values without what follows another quantity, about their mean."""
        apart = other - other.mean()
        return np.asarray(values - apart * (apart @ values) / max(apart @ apart, 1e-300))

    kept, left_out, warnings = _consistent(plan, errors, range(len(captures)), lambda steps: -off(steps).scatter)
    ranges, depths = (beside(values[kept], warm[kept]) for values in (measured, true))
    if ranges.std() < APART * measured[kept].std():
        raise RequestError("steps: temperature_c rises or falls with depth_m, so that the drift cannot be told from the scale: measure "
                           "some distances again at another temperature")
    scale, offset = fit_line(ranges, depths)
    if abs(scale - 1) > MOST_SCALED:
        raise RequestError(found.others(MOST_SCALED * float(np.median(true))) or (
            f"steps: depth_m grows by {scale:.3g} m for each metre of the measured ranges: check depth_m, its unit, the order of the "
            "captures, and their bin_s"))
    middle, spread = float(measured[kept].mean()), float(ranges.std())
    entries = {"scale": scale, "offset_m": offset}
    freedom = len(kept) - (3 if plan.has_drift else 2)
    if freedom < 1:
        return _Found(entries, None, left_out, warnings)
    left = depths - scale * ranges + offset
    # that of any other distance, which a line through a bend misses by as much
    sigma = float(np.sqrt(np.sum(left**2) / freedom) * stdtrit(freedom, ndtr(2)) / 2)  # 2 σ hold what Student's t has within them
    entries |= {"middle_m": float(f"{middle:.4g}"), "scale_sigma": float(f"{sigma / spread / np.sqrt(len(kept)):.3g}")}
    if plan.has_drift:  # what the drift leaves open at temperatures as far apart as those of the sweep
        own = max(float(beside(warm[kept], measured[kept]).std()), 1e-300)
        sigma *= float(np.hypot(1, warm[kept].std() / own / np.sqrt(len(kept))))
    return _Found(entries, sigma, left_out, warnings)


def _fit_wiggling(plan: Sweep, captures: list[Capture], found: _Measured, device: str, timings: Timings) -> _Found:
    """Fit the harmonics of each frequency to the steps at the commonest temperature."""
    errors = found.errors
    chosen = [number for number, step in enumerate(plan.steps) if step.temperature_c == plan.commonest_temperature_c]
    phases = _phases(plan, captures, chosen, device, timings)
    if not phases:
        raise CalibrationError(f"steps: no phase is known to {SHARPEST_RAD:g} radians: take a brighter target, or more frames of each step")
    highest = max(phases)  # the surest, on which ranges rest
    per_radian = SPEED_OF_LIGHT / (4 * np.pi * highest)
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(errors - np.median(errors))))
    most = MOST_SCATTER * 2 * np.pi * per_radian
    if scatter > most:
        falls = ", and reference_phase_rad of the frames (--signal of relit import tof), for the ranges fall where depth_m grows"
        raise RequestError(found.others(most) or (
            f"steps: measured ranges differ from the declared distances by {scatter:.2g} m more at some than at others, which is no "
            f"wiggling: check depth_m, its unit, and the order of the captures{falls if found.falls else ''}"))

    def some(hz: float, steps: Iterable[int]) -> list[StepPhases]:
        return [phases[hz][step] for step in steps if step in phases[hz]]

    seen = sum(len(readings.phase) for readings in phases[highest].values())
    phases = {hz: of_target(own, hz) for hz, own in phases.items()}
    turn = target_faults(some(highest, phases[highest]), highest).turn
    phases = {hz: of_target({step: readings.turned(turn) for step, readings in own.items()}, hz) for hz, own in phases.items()}
    off_plane = 1 - sum(len(readings.phase) for readings in phases[highest].values()) / seen
    kept, left_out, warnings = _consistent(plan, errors, phases[highest],
                                           lambda steps: fit_wiggling(some(highest, steps), highest).scatter * per_radian)
    if turn.any():
        axis, degrees = max(zip(("upright", "level"), np.degrees(np.arctan(np.abs(turn))), strict=True), key=lambda each: each[1])
        warnings = (*warnings, f"steps: the target does not face the camera: it is turned by {degrees:.2g}° about the {axis} axis in all "
                               "of them, which is taken out")
    if off_plane > LEAST_OFF_PLANE:
        warnings = (*warnings, f"steps: {off_plane:.0%} of the readings are off the plane of the target, as what stands behind, before or "
                               "beside it, and are left out: give each capture a mask of the target alone")
    scale = target_faults(some(highest, kept), highest).scale
    tables = tuple(fit_harmonics(*all_readings(some(hz, kept)), hz) for hz in phases)
    known = wiggling_sigma({hz: some(hz, kept) for hz in phases})
    sigma = known.most_m
    if known.unseen is not None:
        warnings = (*warnings, f"steps: no distance shows the phases of ranges of about {known.range_m[known.unseen]:.3g} m, where "
                               f"ranges may be off by {known.sigma_m[known.unseen]:.2g} m: measure there too")
    elif sigma > DETERMINED * errors[kept].std():
        warnings = (*warnings, f"steps: ranges are off by {sigma:.2g} m, and by {errors[kept].std():.2g} m without a calibration: measure "
                               "at more distances")
    if scale is not None:
        reach = float(np.median([plan.steps[step].depth_m for step in kept]))
        sigma = float(np.hypot(sigma, (scale - 1) * reach))
        warnings = (*warnings, f"steps: all distances look {scale:.4f} times too long beside the phases: check depth_m and "
                               f"modulation_hz; ranges are {abs(scale - 1) * reach:.2g} m off with it")
    return _Found({"harmonics": tables}, sigma, left_out, warnings)


def _consistent(plan: Sweep, errors: np.ndarray, steps: Iterable[int], fitted: Callable[[list[int]], np.ndarray]
                ) -> tuple[list[int], list[int], tuple[str, ...]]:
    """Leave out steps that contradict the others, one after the other: by far more than wiggling, then by far more than what a fit leaves.
    `errors`: [steps] metres, without a calibration. `fitted`: returns what a fit to some steps leaves of each, metres. Returns the steps
    that are kept, those that are not, and what is to be said."""
    kept, left_out, warnings = list(steps), list[int](), tuple[str, ...]()
    for off in (lambda some: errors[some], fitted):
        most = int(MOST_WRONG * (len(kept) + len(left_out)))
        while len(kept) > FEWEST and len(left_out) < most:
            away = off(kept)
            worst = contradicting(away)
            if worst is None:
                break
            wrong = plan.steps[kept[worst]]
            warnings = (*warnings, f"steps: the depth_m of {wrong.capture}, {wrong.depth_m:g} m, contradicts the others by "
                                   f"{abs(away[worst] - np.median(away)):.2g} m, and is left out")
            left_out.append(kept.pop(worst))
    return kept, left_out, warnings


def _phases(plan: Sweep, captures: list[Capture], chosen: list[int], device: str, timings: Timings
            ) -> dict[float, dict[int, StepPhases]]:
    """Return the phases of some steps at each frequency."""
    timings.stage("wiggling", len(chosen))
    phases: dict[float, dict[int, StepPhases]] = {}
    for done, number in enumerate(chosen, start=1):
        step, capture = plan.steps[number], captures[number]
        frames = read_correlations(capture)
        inside = np.nonzero(capture.mask().reshape(-1))[0]
        some = inside[evenly(len(inside), STEP_PIXELS)]
        noise = estimate_noise(frames.images, frames.modulation_hz, frames.reference_phase_rad, cols=capture.camera.width,
                               scale=frames.scale)
        found = decode(frames.images, frames.modulation_hz, frames.reference_phase_rad, noise=noise,
                       saturation=capture.manifest.saturation, scale=frames.scale, device=device)
        true = _true_half_path(step, capture).reshape(-1)[some]
        aside = np.stack(capture.camera.plane_coordinates(), axis=-1).reshape(-1, 2)[some]
        phase, sigma = to_numpy(found.phase)[:, some], to_numpy(found.sigma)[:, some]
        for row, hz in enumerate(found.modulation_hz.tolist()):
            good = (sigma[row] > 0) & (sigma[row] < SHARPEST_RAD)
            if good.any():
                phases.setdefault(hz, {})[number] = StepPhases(phase[row, good].astype(np.float64), true[good], aside[good],
                                                              capture.camera.projection == "perspective")
        timings.advance(done)
    return phases
