"""Frames whose level varies continuously along the axis: ramps, phase shifting, micro and modulated phase shifting."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from stage.pattern import Axis, ModulatedPattern, Pattern, PhasePattern, RampPattern
from stage.patterns.stripes import uniform_patterns

JOINT = (((16.0, 18.0, 21.0), 1008), ((16.0, 18.0, 22.0), 1280), ((16.0, 22.0, 26.0), 2048), ((16.0, 17.0, 19.0), 4096))
"""Sets of periods and the projector width that they serve. At it, the phases of two places differ by 0.6, 0.5, 0.4 and 0.28 radians
(root sum of squares) at least; 16, 22, 26 repeat after 2288 pixels, 16, 18, 22 after 1584, 16, 17, 19 after 5168."""
MICRO_BAND = 0.15
"""Micro phase shifting keeps its periods within this part of their mean: near enough that one offset and amplitude serve all."""
MICRO_TRIALS = 400
"""Sets of periods that are tried; more improve the distance between codes by a few per cent."""


def ramp_patterns(axis: Axis, *, references: bool = True) -> tuple[Pattern, ...]:
    """Up and down: their ratio gives the coordinate, the object's reflectance cancels; with references white and black too."""
    return (RampPattern(code="ramp", axis=axis, direction="up"), RampPattern(code="ramp", axis=axis, direction="down"),
            *(uniform_patterns() if references else ()))


def joint_periods(extent: int) -> tuple[float, ...]:
    """Three periods about 18 pixels that tell all places of a projector apart, with the phases as far apart as such periods have them.

    Args:
        extent: projector pixels along the axis.

    Raises:
        ValueError: a projector too large for any set here.
    """
    for periods, covered in JOINT:
        if extent <= covered:
            return periods
    raise ValueError(f"the projector has {extent} px, the sets of three periods end at {JOINT[-1][1]}: name periods")


def phase_patterns(axis: Axis, periods_px: Sequence[float], steps: int = 4) -> tuple[Pattern, ...]:
    """Every step of every period.

    Args:
        axis: of the code.
        periods_px: any number of periods, in projector pixels.
        steps: of each, 3 or more, evenly spaced.

    Raises:
        ValueError: no period, or one given twice.
    """
    if not periods_px or len(set(periods_px)) < len(periods_px):
        raise ValueError(f"periods {_text(periods_px)} are not several different ones: give each once, and at least one")
    return tuple(PhasePattern(code="phase", axis=axis, period_px=period, step=step, steps=steps)
                 for period, step in product(periods_px, range(steps)))


def micro_patterns(extent: int, axis: Axis, *, periods: int = 5, mean_period_px: float = 16.0) -> tuple[Pattern, ...]:
    """Micro phase shifting: three steps of the first period, one frame of each other; all periods short and close to each other.

    All frequencies are high, so light between surfaces adds the same constant to every frame; they lie close together, so
    defocus dims all alike, and one offset and one amplitude serve all frames.

    Args:
        extent: projector pixels along the axis, over which no two places look alike.
        axis: of the code.
        periods: how many, 3 or more; there are two more frames than periods.
        mean_period_px: about which the periods lie.

    Raises:
        ValueError: too few periods.

    Source:
        Gupta and Nayar, "Micro Phase Shifting", CVPR 2012, sections 3 and 4: N + 2 images for N frequencies.
    """
    chosen = micro_periods(extent, periods, mean_period_px)
    first = [PhasePattern(code="phase", axis=axis, period_px=chosen[0], step=step, steps=3) for step in range(3)]
    return (*first, *(PhasePattern(code="phase", axis=axis, period_px=period, step=0, steps=3) for period in chosen[1:]))


def micro_periods(extent: int, count: int, mean_period_px: float) -> tuple[float, ...]:
    """Periods near a mean under which the places of the projector look most unlike: the best of many fixed random sets.

    Compared is the smallest distance, over offsets of whole first periods, between the cosines seen at two places, on a grid.
    """
    if count < 3:
        raise ValueError(f"{count} periods cannot tell the places apart: give 3 or more")
    rng = np.random.default_rng(0)
    best = -1.0
    chosen: tuple[float, ...] = ()
    for _ in range(MICRO_TRIALS):
        low, high = mean_period_px * (1 - MICRO_BAND), mean_period_px * (1 + MICRO_BAND)
        periods = np.sort(np.round(rng.uniform(low, high, count), 2))
        offsets = np.arange(1, int(extent / periods[0]) + 1) * periods[0]
        at = np.linspace(0, extent, 64, endpoint=False)[:, None, None]
        here = np.cos(2 * np.pi * at / periods[1:])
        there = np.cos(2 * np.pi * (at + offsets[:, None]) / periods[1:])
        distance = float(np.linalg.norm(there - here, axis=-1).min())
        if distance > best:
            best, chosen = distance, tuple(float(period) for period in periods)
    return chosen


def modulated_patterns(axis: Axis, period_px: float, *, steps: int = 4, carrier_period_px: float = 8.0,
                       carrier_steps: int = 3) -> tuple[Pattern, ...]:
    """A long period that needs no unwrapping, under a fine carrier along the other axis that separates the direct light.

    Source:
        Chen, Seidel and Lensch, "Modulated phase-shifting for 3D scanning", CVPR 2008.
    """
    return tuple(ModulatedPattern(code="modulated", axis=axis, period_px=period_px, step=step, steps=steps,
                                  carrier_period_px=carrier_period_px, carrier_step=carrier, carrier_steps=carrier_steps)
                 for step, carrier in product(range(steps), range(carrier_steps)))


def _text(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values) or "(none)"
