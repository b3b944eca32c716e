"""Fits to a flat target at known distances without each distance in turn: how far the calibration of a time-of-flight camera is known, and
which distances contradict the others.

The pixels of one distance err alike, so that a fit to all pixels would be sure of anything: what the other distances say of one tells how
far a calibration is known between its distances. Where in a period it is known follows from the phases that the distances show.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from stage.spread import MAD_TO_SIGMA
from stage.tof.calibration import LEAST_TERM, harmonic_terms, phase_errors
from stage.tof.light_time import SPEED_OF_LIGHT

LEAST_TURNS = 1.5
"""The least part of a period over which distances that are all too long by a part of them are no wiggling."""
SURE = 4.0
"""Standard errors beyond which a turn of the target or a scale of its distances is one, and a distance contradicts the others."""
LEAST_TURN, LEAST_SCALE = 0.005, 5e-4
"""The least tangent of a turn of the target, 0.3 degrees, and the least part by which all distances are too long."""
ROUNDS = 3
"""Fits of the turn, whose effect on ranges is not linear."""
FOLLOWED = 0.1
"""Squares that a fit leaves, over those of the fits without each step, below which it follows every step."""
SETTLED_M = 1e-3
"""Scatter of distances below which none contradicts the others."""
PLACES = 1440
"""Ranges at which the fit of the wiggling is judged: thirty in a period of the highest harmonic, over four periods."""
UNKNOWN_RAD = np.pi / 3**0.5
"""Standard deviation of a phase of which nothing is known."""
OFF_PLANE, LEAST_OFF = 5.0, 0.01
"""Robust standard deviations of what a fit leaves of a step's readings beyond which one is off the plane of the target; least radians."""
GAP = 4.0
"""Standard deviation at a range, over the median of all, above which no distance shows its phases; 1.2 to 3 where distances do."""


class StepPhases(NamedTuple):
    """The phases of one frequency at one distance of the target."""

    phase: np.ndarray  # [n] radians, measured
    range_m: np.ndarray  # [n] true
    aside: np.ndarray  # [n, 2] where the line of sight meets the plane at depth 1; orthographic: at any depth, metres
    perspective: bool = True

    def turned(self, turn: np.ndarray) -> "StepPhases":
        """Return the phases with the ranges of a target that is turned: [2] tangents, about the upright and the level axis."""
        nearer = self.aside @ turn
        return self._replace(range_m=self.range_m / (1 - nearer) if self.perspective else self.range_m + nearer)

    def per_turn(self, turn: np.ndarray) -> np.ndarray:
        """Return the change of the ranges of a target that is turned, [n, 2] metres for a tangent."""
        return self.aside * (self.range_m / (1 - self.aside @ turn) ** 2)[:, None] if self.perspective else self.aside


def all_readings(steps: Sequence[StepPhases]) -> tuple[np.ndarray, np.ndarray]:
    """Return the phases and the true ranges of all steps, [n] each."""
    return np.concatenate([step.phase for step in steps]), np.concatenate([step.range_m for step in steps])


class Fit(NamedTuple):
    """A linear fit to steps of readings."""

    values: np.ndarray  # [unknowns]
    spread: np.ndarray  # [unknowns] standard errors by the jackknife over the steps
    left: np.ndarray  # [steps] mean of the readings of each step less the fit
    left_out: np.ndarray  # [steps] the same for a fit without the step

    @property
    def scatter(self) -> np.ndarray:
        """What the steps are off, [steps], of equal variance: √(left · left_out) has that of a step's own error.

        Zeros where the fit follows each step, so that none can contradict the others.
        """
        told = np.sum(self.left**2) > FOLLOWED * np.sum(self.left_out**2)
        return np.asarray(np.sqrt(np.maximum(self.left * self.left_out, 0)) * np.sign(self.left) * told)


def fit_steps(matrices: Sequence[np.ndarray], targets: Sequence[np.ndarray]) -> Fit:
    """Fit matrices [n, unknowns] of steps to their readings [n] by least squares, and without each step in turn."""
    parts = [np.linalg.qr(np.column_stack([matrix, target])) for matrix, target in zip(matrices, targets, strict=True)]
    rows = [part.R for part in parts]  # a step's readings as no more rows than unknowns
    middles = np.array([np.append(matrix.mean(axis=0), target.mean()) for matrix, target in zip(matrices, targets, strict=True)])

    def solved(own: Sequence[np.ndarray]) -> np.ndarray:
        all_rows = np.concatenate(own)
        return np.asarray(np.linalg.lstsq(all_rows[:, :-1], all_rows[:, -1], rcond=LEAST_TERM)[0])

    values = solved(rows)
    without = np.array([solved([*rows[:step], *rows[step + 1:]]) for step in range(len(rows))])
    count = len(rows)
    spread = np.sqrt((count - 1) * without.var(axis=0))
    left = middles[:, -1] - middles[:, :-1] @ values
    return Fit(values, spread, left, middles[:, -1] - (middles[:, :-1] * without).sum(axis=1))


def fit_wiggling(steps: Sequence[StepPhases], modulation_hz: float) -> Fit:
    """Fit the harmonics of one frequency to phases that were measured at known distances, in radians, as `fit_harmonics` does to all at
    once."""
    return fit_steps([harmonic_terms(step.phase) for step in steps], _errors(steps, modulation_hz))


def of_target(steps: Mapping[int, StepPhases], modulation_hz: float) -> dict[int, StepPhases]:
    """Return the readings of steps without those off the plane of the target, as of what stands behind it, before it and beside it."""
    found = dict(steps)
    for _ in range(ROUNDS):
        readings = list(found.values())
        values = fit_wiggling(readings, modulation_hz).values
        for number, step, error in zip(found, readings, _errors(readings, modulation_hz), strict=True):
            left = error - harmonic_terms(step.phase) @ values
            away = np.abs(left - np.median(left))
            held = away <= max(OFF_PLANE * MAD_TO_SIGMA * float(np.median(away)), LEAST_OFF)
            found[number] = step._replace(phase=step.phase[held], range_m=step.range_m[held], aside=step.aside[held])
    return found


def part_at(off_m: Sequence[np.ndarray], near_m: float, repeat_m: float | None) -> np.ndarray:
    """Return the part of each step's readings that is off by one length in all steps, within `near_m`, [steps]: the length that most steps
    have. `off_m`: [n] metres of each step; `repeat_m`: what they repeat after; None: nothing."""
    every = np.concatenate(off_m)
    span = np.ptp(every) + 2 * near_m if repeat_m is None else repeat_m
    count = max(int(np.ceil(2 * span / near_m)), 1)
    places = [((off - every.min()) % span / span * count).astype(int) % count for off in off_m]
    parts = np.array([np.bincount(place, minlength=count) / len(place) for place in places])
    wide = np.sum([np.roll(parts, shift, axis=1) for shift in range(-2, 3)], axis=0) if count >= 5 else parts
    return np.asarray(wide[:, int(np.minimum(wide, 0.5).mean(axis=0).argmax())])


class WigglingSigma(NamedTuple):
    """How far ranges are known from the nearest to the farthest distance of a sweep, and over the rest of a period of its highest
    frequency."""

    range_m: np.ndarray  # [PLACES]
    sigma_m: np.ndarray  # [PLACES] standard deviations that the fitted wiggling leaves
    reached: np.ndarray  # [PLACES] bool, not beyond the farthest distance

    @property
    def most_m(self) -> float:
        """Return the largest standard deviation from the nearest to the farthest distance."""
        return float(self.sigma_m[self.reached].max())

    @property
    def unseen(self) -> int | None:
        """Return the place that is known least, where no distance shows its phases; None if the distances show all."""
        worst = int(self.sigma_m.argmax())
        return worst if self.sigma_m[worst] > GAP * np.median(self.sigma_m[self.reached]) else None


def wiggling_sigma(phases: Mapping[float, Sequence[StepPhases]]) -> WigglingSigma:
    """Return how far what `fit_wiggling` finds at each frequency leaves ranges open, whose phases are equally sure at all of them.
    `phases`: the steps at each frequency in hertz."""
    ranges = [float(np.median(step.range_m)) for steps in phases.values() for step in steps]
    nearest, farthest = min(ranges), max(ranges)
    range_m = np.linspace(nearest, max(farthest, nearest + SPEED_OF_LIGHT / (2 * max(phases))), PLACES)
    weights = {hz: hz**2 / sum(each**2 for each in phases) for hz in phases}
    sigma_m = sum(weight * _sigma_at(range_m, phases[hz], hz) for hz, weight in weights.items())  # missed distances err in all alike
    return WigglingSigma(range_m, np.asarray(sigma_m), range_m <= farthest)


def _sigma_at(range_m: np.ndarray, steps: Sequence[StepPhases], modulation_hz: float) -> np.ndarray:
    """Return the standard deviations of ranges [n] by one frequency: those of least squares on readings of which those of one step err
    alike, and each by itself beside that."""
    terms, errors = [harmonic_terms(step.phase) for step in steps], _errors(steps, modulation_hz)
    fit = fit_wiggling(steps, modulation_hz)
    own = np.concatenate([error - matrix @ fit.values - left for matrix, error, left in zip(terms, errors, fit.left, strict=True)])
    alike_variance = float(np.maximum(fit.left * fit.left_out, 0).mean())
    scales, axes = np.linalg.eigh(sum(matrix.T @ matrix for matrix in terms))
    inverse = axes / np.maximum(scales, LEAST_TERM**2 * scales[-1]) @ axes.T
    per_metre = 4 * np.pi * modulation_hz / SPEED_OF_LIGHT
    at = harmonic_terms(range_m * per_metre + np.concatenate(errors).mean())
    alike = at @ inverse @ np.column_stack([matrix.sum(axis=0) for matrix in terms])
    variance = alike_variance * (alike**2).sum(axis=1) + own.var() * ((at @ inverse) * at).sum(axis=1)
    return np.asarray(np.minimum(np.sqrt(variance), UNKNOWN_RAD)) / per_metre


class TargetFaults(NamedTuple):
    """What the phases say of how a target was placed."""

    turn: np.ndarray  # [2] tangents of the turn about the upright and the level axis; 0 where it is not sure
    scale: float | None
    """Declared distances over true ones; None: not sure to differ from 1."""


def target_faults(steps: Sequence[StepPhases], modulation_hz: float) -> TargetFaults:
    """Return by how much the target is turned in all steps, and by which factor all distances are declared too long: neither repeats with
    the phase as wiggling does. `modulation_hz`: the highest, whose phases are the surest."""
    metre = 4 * np.pi * modulation_hz / SPEED_OF_LIGHT
    reach = metre * np.ptp([np.median(step.range_m) for step in steps]) / (2 * np.pi)
    turn, sure = np.zeros(2), np.zeros(3, bool)
    too_long = 0.0
    for _ in range(ROUNDS):
        placed = [step.turned(turn) for step in steps]
        columns = [metre * np.column_stack([step.per_turn(turn), *([own.range_m] if reach > LEAST_TURNS else [])])
                   for step, own in zip(steps, placed, strict=True)]
        fit = fit_steps([np.column_stack([harmonic_terms(step.phase), own]) for step, own in zip(steps, columns, strict=True)],
                        _errors(placed, modulation_hz))
        count = columns[0].shape[1]
        found, spread = fit.values[-count:], fit.spread[-count:]
        turn = turn + found[:2]
        sure[:count] = np.abs([*turn, *found[2:]]) > SURE * spread
        too_long = float(1 / (1 + found[2]) - 1) if count > 2 else 0.0
    return TargetFaults(np.where(sure[:2] & (np.abs(turn) > LEAST_TURN), turn, 0.0),
                        1 + too_long if sure[2] and abs(too_long) > LEAST_SCALE else None)


def contradicting(off_m: np.ndarray) -> int | None:
    """Return the number of the step that is off by far more than the others, [steps] metres; None if none is."""
    away = np.abs(off_m - np.median(off_m))
    scatter = max(MAD_TO_SIGMA * float(np.median(away)), SETTLED_M)
    worst = int(away.argmax())
    return worst if away[worst] > 1.5 * SURE * scatter else None


def _errors(steps: Sequence[StepPhases], modulation_hz: float) -> list[np.ndarray]:
    """Return by how much the phases of each step differ from those of its ranges, radians about one mean."""
    errors = phase_errors(*all_readings(steps), modulation_hz)
    return np.split(errors, np.cumsum([len(step.phase) for step in steps])[:-1])
