"""Checks of waves that no stripes number: their direction, offset and periods, by what the waves tell of each other and of the scene.

Several periods agree on one place only if they are declared as they were shown. One wave over the whole projector agrees with any
declaration; but a surface cannot pass from the last column to the first, order is kept along the line that joins camera and projector, and
depths lie in front of both. Where these leave another offset as good as the declared one, that is said.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from kernels.errors import ArrayError
from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import weights
from kernels.structured.response import BINS, bent_wave, phase_table
from kernels.structured.triangulate import ProjectorModel
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.pattern_checks import ENOUGH, Sample
from service.depth.patterns.wave_order import other_orders
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.kary import KaryCode
from stage.patterns.phase import FULL_STEPS, PhaseCode

CLEAR_SIGMAS = 6.0
"""Least amplitude of the waves of a pixel that is compared, in deviations of a reading."""
SOME, SOME_FOR_PERIODS = 1500, 500
"""Numbers of pixels that are compared, and that other periods are tried on."""
MISFIT = 0.012
"""Median misfit of the waves at the place that fits best, turns, below which they agree: noise, blur and steep surfaces leave less."""
NOISE_TIMES = 1.6
"""The same in deviations of noise."""
BETTER = 0.5
"""Part of what this misfit has beyond noise that another declaration may leave, to be named."""
BENDS = (0.0, 0.015, 0.03, 0.045, -0.015, -0.03)
"""Errors of the phases of bent waves, turns, that are tried, so that a bent wave is not taken for another one."""
PERIOD_SPAN, PERIOD_STEP = 0.25, 0.1
"""Largest change of a period that is tried, as a part, and the step between two, in turns over the projector."""
AVERAGED, ALIKE = 5, 0.9
"""Neighbours of a row over which one wave is averaged against noise, and the least length of the mean of their phasors: less at edges."""
SMOOTH = 0.05
"""Largest difference of the phases of neighbouring pixels of one surface, turns."""
BESIDE = 0.04
"""Turns by which a surface must go on to both sides of the border of the projector that it seems to cross: more than noise and blur."""
CROSSINGS, CROSSING_SHARE = 6, 0.1
"""Number of image rows in which surfaces cross that border, and their part of the rows with waves, from which on it is none."""
RUN = 12
"""Number of neighbouring pixels over which order is looked at."""
RUNS = 40
"""Number of such runs that rise or fall clearly, below which order tells nothing."""
AGAINST = 0.75
"""Part of the runs against the order of the projector, from which on the direction is named."""
IMPOSSIBLE, POSSIBLE = 0.1, 0.02
"""Part of the depths that lie behind the camera or the projector, from which on an offset is wrong, and up to which it may be right."""
EXPONENTS = (0.4, 3.0)
"""Least and greatest exponent of light = level^γ under which the periods of bent waves are compared."""
MEDIAN_SQUARE = 0.6
"""Median of the squared misfit over its variance: ln 2 of three periods, 0.45 of two."""
OFFSETS = ((0.25, "-π/2"), (0.5, "π"), (-0.25, "π/2"))
"""Turns to add to the phases, and the change of offset_rad that this makes."""
SPAN_STEP, LOOSE = 1 / 72, 0.05
"""Turns between the offsets of one wave that are tried, and turns over which they fit from which on that is said: a fifth of another
frame in each shifts the wave by that much."""


class Waves(NamedTuple):
    """The phases of the bright pixels of a sample."""

    turns: np.ndarray  # [periods, rows, cols] 0 … 1, as declared
    deviation: np.ndarray  # [rows, cols] of noise, turns
    clear: np.ndarray  # [rows, cols] bool
    periods: np.ndarray  # [periods] px
    extent: int
    steps: int
    """Least number of steps of a period: a bent wave errs with so many times its phase."""


class WaveFindings(NamedTuple):
    """Results of the check."""

    wrong: str | None
    """A sentence if the waves are declared otherwise than they were shown."""
    unconfirmed: str | None
    """A sentence if nothing in the capture confirms what is declared."""


def check_waves(sample: Sample, collected: Collected, projector: PatternProjector, model: ProjectorModel | None,
                noise: NoiseModel) -> WaveFindings:
    """Return what the waves of each axis without stripes say of their declaration; `model` is None without calibration."""
    said = None
    alone = len({code.axis for code in collected.codes}) == 1
    for code in unnumbered(collected):
        waves = waves_of(sample, code, projector, noise)
        if waves is None:
            continue
        if len(waves.periods) > 1:
            wrong, unconfirmed = _check_several(waves), None
        elif waves.periods[0] >= waves.extent:
            wrong, unconfirmed = _check_one(waves, sample, model, 0 if code.axis == "column" else 1, alone=alone)
        else:
            continue
        if wrong is not None:
            return WaveFindings(f"frames: the {code.axis} phases {wrong} in the frames' patterns", None)
        if unconfirmed is not None and said is None:
            said = f"frames[].pattern: the {code.axis} phases {unconfirmed}"
    return WaveFindings(None, said)


def unnumbered(collected: Collected, *, least_periods: int = 1) -> list[PhaseCode]:
    """Return the waves, of so many periods at least, that no stripes of their axis number."""
    numbered = {code.axis for code in collected.codes if isinstance(code, BinaryCode | KaryCode)}
    return [code for code in collected.codes if isinstance(code, PhaseCode) and not code.micro and code.axis not in numbered
            and len(set(code.periods_px)) >= least_periods]


def waves_of(sample: Sample, code: PhaseCode, projector: PatternProjector, noise: NoiseModel) -> Waves | None:
    """Return the phases of each period; None if fewer than ENOUGH pixels have all of them."""
    grey = sample.grey
    waves = code.waves
    turns, deviation, clear = [], np.zeros(grey.shape[1]), sample.whole.copy()
    for period, frames, turns_of in waves:
        if len(frames) < FULL_STEPS:
            return None
        shifts = np.array(turns_of)
        table = weights(shifts, period)
        readings = grey[list(frames)].astype(np.float64)
        mean, along, across = table.T @ readings
        swing = np.hypot(along, across)
        spread = np.sqrt(noise.variance(mean))
        clear &= swing > CLEAR_SIGMAS * spread
        phase = np.arctan2(across, along) % (2 * np.pi)
        if projector.wave_response is not None:
            bend = phase_table(bent_wave(projector.wave_response), table, shifts, period)[:, 0]
            phase = phase + np.interp(phase, np.linspace(0, 2 * np.pi, BINS + 1), bend)
        turns.append(phase / (2 * np.pi) % 1.0)
        deviation = np.maximum(deviation, np.sqrt(2 / len(frames)) * spread / np.maximum(swing, 1e-12) / (2 * np.pi))
    if clear.sum() < ENOUGH:
        return None
    shape = sample.mask.shape
    steps = min(len(wave.frames) for wave in waves)
    return Waves(np.stack(turns).reshape(-1, *shape), deviation.reshape(shape), clear.reshape(shape),
                 np.array([wave.period_px for wave in waves]),
                 projector.extent(code.axis), steps)


def some_of(waves: Waves, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the phases [periods, pixels] of so many clear pixels, evenly spread, and their deviations."""
    at = np.flatnonzero(waves.clear)
    at = at[:: max(1, len(at) // count)]
    return waves.turns.reshape(len(waves.periods), -1)[:, at], waves.deviation.ravel()[at]


def joint_fit(turns: np.ndarray, periods: np.ndarray, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the misfit of phases [periods, pixels] at the place of the projector that fits best, turns per degree of freedom, and that
    place, pixels; each [pixels]."""
    frequency = 1 / periods
    shortest = int(np.argmin(periods))
    wraps = np.arange(-1, int(np.ceil(extent / periods[shortest])) + 1)
    place = (turns[shortest] + wraps[:, None]) * periods[shortest]
    rest = place * frequency[:, None, None] - turns[:, None]
    rest -= np.round(rest)
    slope = np.tensordot(frequency, rest, 1) / (frequency @ frequency)
    squares = (rest**2).sum(axis=0) - slope**2 * (frequency @ frequency)
    border = 0.05 * periods[shortest]
    inside = (place - slope >= -border) & (place - slope <= extent + border)
    squares = np.maximum(np.where(inside, squares, 1.0), 0)
    best = squares.argmin(axis=0)[None]
    least, where = (np.take_along_axis(each, best, axis=0)[0] for each in (squares, place - slope))
    return np.sqrt(least / (len(periods) - 1)), where


def _check_several(waves: Waves) -> str | None:
    """Return how several periods are declared otherwise than they were shown; None if they agree, or nothing else makes them agree."""
    turns, deviation = some_of(waves, SOME)

    def misfit(shown: np.ndarray, periods: np.ndarray, bends: tuple[float, ...] = BENDS) -> float:
        return min(float(np.median(joint_fit(shown + bend * np.sin(2 * np.pi * waves.steps * shown), periods, waves.extent)[0]))
                   for bend in bends)

    declared, noise = misfit(turns, waves.periods), float(np.median(deviation))
    if declared < max(MISFIT, NOISE_TIMES * noise):
        return None
    limit = BETTER * (declared**2 - MEDIAN_SQUARE * noise**2) ** 0.5
    limit = float(np.hypot(limit, MEDIAN_SQUARE**0.5 * noise))
    found = [(misfit(-turns % 1.0, waves.periods), "fit each other if their steps run backwards: check step"),
             *((misfit(turns + change, waves.periods), f"fit each other if their offset is changed by {words}: check offset_rad and step")
               for change, words in OFFSETS), *((misfit(turns, periods), order) for periods, order in other_orders(waves.periods))]
    best, words = min(found)
    if best > max(MISFIT, NOISE_TIMES * noise):  # none of them makes all agree
        def other_misfit(index: int, period: float) -> float:
            periods = np.where(np.arange(len(waves.periods)) == index, period, waves.periods)
            return misfit(some_of(waves, SOME_FOR_PERIODS)[0], periods, (0.0,))

        _, index, other = min((other_misfit(index, period), index, period) for index in range(len(waves.periods))
                              for period in _periods_about(waves.periods, index, waves.extent))
        of_period, other = min((other_misfit(index, period), period)
                               for period in other + np.linspace(-1, 1, 41) * PERIOD_STEP * other**2 / waves.extent)
        text = f"of {waves.periods[index]:g} px fit the others as waves of {other:.3g} px: check period_px"
        best, words = min((best, words), (of_period, text))
    if best > limit:
        return None
    return f"contradict each other by {360 * declared:.2g}° as declared ({360 * best:.2g}° else), and {words}"


def _periods_about(periods: np.ndarray, index: int, extent: int) -> np.ndarray:
    """Return the periods that are tried in place of one of them."""
    low, high = 1 / (1 + PERIOD_SPAN), 1 / (1 - PERIOD_SPAN)
    turns = extent / periods[index]
    return np.asarray(extent / np.arange(low * turns, high * turns, PERIOD_STEP))


def _check_one(waves: Waves, sample: Sample, model: ProjectorModel | None, axis: int, *, alone: bool) -> tuple[str | None, str | None]:
    """Return how one wave over the projector is declared otherwise than it was shown, and what nothing confirms."""
    phasor = np.where(waves.clear, np.exp(2j * np.pi * waves.turns[0]), 0)
    mean = uniform_filter1d(phasor.real, AVERAGED, axis=1) + 1j * uniform_filter1d(phasor.imag, AVERAGED, axis=1)
    clear = waves.clear & (np.abs(mean) > ALIKE)
    turns = np.angle(mean) / (2 * np.pi) % 1.0
    forward = _order(turns, clear, model, axis)
    if forward is not None and forward < 1 - AGAINST:
        if model is not None:
            return ("run against the order in which camera and projector see one surface: their steps run backwards, or the projected "
                    "image is mirrored: check step"), None
        return None, ("run against the image: check step, whose order may be reversed, unless the projector is mirrored or upside down")

    def state(change: float) -> tuple[bool, float]:
        shown = (turns + change) % 1.0
        return _crosses(shown, clear), (0.0 if model is None else _impossible(shown, clear, waves, sample, model, axis))

    crosses, impossible = state(0.0)
    others = {words: state(change) for change, words in OFFSETS}
    possible = [words for words, (crossing, part) in others.items() if not crossing and part <= POSSIBLE]
    if crosses or impossible > IMPOSSIBLE:
        seen = ("pass from the last column or row to the first inside surfaces" if crosses else
                f"put {100 * impossible:.0f} % of the points behind the camera or the projector")
        named = f"; changed by {possible[0]} it would not" if len(possible) == 1 else ""
        return (f"{seen}: one wave of {waves.periods[0]:g} px over the projector does not{named}: check offset_rad (a sine has -π/2), step "
                "and period_px"), None
    if not alone:
        return None, None
    low, high = (_last_that_fits(sign, state) for sign in (1, -1))
    if not possible and low + high < LOOSE:
        return None, None
    beyond = [words for change, words in OFFSETS if words in possible and not -high <= change <= low]
    ways = [f"-{360 * low:.0f}° to +{360 * high:.0f}°", *beyond]
    return None, (f"are one wave, whose offset_rad nothing in the capture confirms: changed by {' or '.join(ways)} it would fit as "
                  "well, and all depths would be others, which the standard deviations do not hold; frames that hold part of the next one, "
                  "what moves and light that bounces between surfaces change it: add a Gray code, the other axis, or a second period")


def _last_that_fits(sign: int, state: Callable[[float], tuple[bool, float]]) -> float:
    """Return by how many turns a wave can be shifted in one direction before surfaces cross the projector's border, or lie behind it."""
    for count in range(1, round(0.5 / SPAN_STEP) + 1):
        crossing, part = state(sign * count * SPAN_STEP)
        if crossing or part > POSSIBLE:
            return (count - 1) * SPAN_STEP
    return 0.5


def _order(turns: np.ndarray, clear: np.ndarray, model: ProjectorModel | None, axis: int) -> float | None:
    """Return the part of the runs along the image rows on which a wave runs in the order of the projector; None if too few tell."""
    if axis == 1:  # rows of a sample are too far apart to follow what changes down the image
        return None
    ahead = 1.0
    if model is not None:
        ray = np.array([[x, 0.0, -1.0] for x in (-0.01, 0.01)]) @ model.projector_from_camera[:, :3].T
        if (ray[:, 2] <= 0).any():
            return None
        step = np.diff(ray[:, 0] / ray[:, 2])[0]
        if abs(step) < 0.5 * np.linalg.norm(np.diff(ray[:, :2] / ray[:, 2:], axis=0)):
            return None
        ahead = float(np.sign(step))
    changes = np.diff(turns, axis=1)
    changes -= np.round(changes)
    smooth = clear[:, 1:] & clear[:, :-1] & (np.abs(changes) < SMOOTH)
    count = changes.shape[1] // RUN
    if count == 0:
        return None
    runs = np.where(smooth, changes, 0)[:, : count * RUN].reshape(-1, RUN).sum(axis=1)
    whole = smooth[:, : count * RUN].reshape(-1, RUN).all(axis=1)
    noise = 2 * np.median(np.abs(changes[smooth] - np.median(changes[smooth]))) if smooth.any() else 0.0
    told = runs[whole & (np.abs(runs) > 2 * noise)] * ahead
    return float((told > 0).mean()) if len(told) >= RUNS else None


def _crosses(turns: np.ndarray, clear: np.ndarray) -> bool:
    """Return whether surfaces pass from the last column of the projector to the first."""
    rows = crossed = 0
    for line, seen in zip(turns, clear, strict=True):
        changes = np.diff(line)
        changes -= np.round(changes)
        joined = seen[1:] & seen[:-1] & (np.abs(changes) < SMOOTH)
        rows += bool(joined.any())
        ends = np.flatnonzero(np.diff(np.concatenate([[0], joined.astype(np.int8), [0]])))
        for first, last in zip(ends[::2], ends[1::2], strict=True):
            along = line[first] + np.concatenate([[0.0], np.cumsum(changes[first:last])])
            borders = np.arange(np.ceil(along.min() + BESIDE), np.floor(along.max() - BESIDE) + 1)
            if len(borders):
                crossed += 1
                break
    return crossed >= max(CROSSINGS, CROSSING_SHARE * rows)


def _impossible(turns: np.ndarray, clear: np.ndarray, waves: Waves, sample: Sample, model: ProjectorModel, axis: int) -> float:
    """Return the part of the clear pixels whose line of sight meets the declared column or row behind the camera or the projector; 0 where
    the projector stands so that columns or rows hardly tell depths."""
    shift = np.abs(model.projector_from_camera[:, 3])
    if shift[axis] < shift.max():
        return 0.0
    place = (turns[clear] * waves.periods[0] - model.principal[axis]) / model.focal[axis]
    ray = np.stack([sample.x[clear], sample.y[clear], -np.ones_like(place)])
    own = model.projector_from_camera[:, :3] @ ray
    depth = (model.projector_from_camera[2, 3] * place - model.projector_from_camera[axis, 3]) / (own[axis] - own[2] * place)
    return 0.0 if not depth.size else float((~(depth > 0) | ~(own[2] * depth + model.projector_from_camera[2, 3] > 0)).mean())


def bent_back(sample: Sample, collected: Collected, projector: PatternProjector, noise: NoiseModel) -> PatternProjector | None:
    """Return the projector with the exponent of light = level^γ under which several periods agree, and the error that it leaves; None if
    they agree without one, or under none."""
    for code in unnumbered(collected, least_periods=2):
        plain = _fit(sample, code, projector, 1.0, noise)
        if plain is None or plain[0] < max(MISFIT, NOISE_TIMES * plain[1]):
            continue
        fits = {1.0: plain}
        for step in (0.2, 0.05):  # about the best so far
            best = min(fits, key=lambda exponent: fits[exponent][0])
            low, high = EXPONENTS if step == 0.2 else (best - 0.2, best + 0.2)
            for exponent in np.arange(low, high + step / 2, step).round(2):
                found = _fit(sample, code, projector, float(exponent), noise)
                if found is not None:
                    fits[float(exponent)] = found
        best = min(fits, key=lambda exponent: fits[exponent][0])
        left, spread = fits[best]
        if left <= BETTER * plain[0]:
            return projector._replace(exponent=best, left_rad=2 * np.pi * max(left**2 / MEDIAN_SQUARE - spread**2, 0.0) ** 0.5)
    return None


def _fit(sample: Sample, code: PhaseCode, projector: PatternProjector, exponent: float, noise: NoiseModel) -> tuple[float, float] | None:
    """Return the median misfit of waves that are bent back by an exponent, and the deviation of noise, turns; None where they do not tell
    places apart."""
    try:
        waves = waves_of(sample, code, projector._replace(exponent=exponent, left_rad=0.0), noise)
    except ArrayError:  # two places look alike under this response
        return None
    if waves is None:
        return None
    turns, deviation = some_of(waves, SOME)
    return float(np.median(joint_fit(turns, waves.periods, waves.extent)[0])), float(np.median(deviation))
