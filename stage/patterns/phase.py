"""Phase shifting: sinusoids of one or several periods, each shown at several shifts; and micro phase shifting.

Sources: Srinivasan, Liu and Halioua, "Automated phase-measuring profilometry of 3-D diffuse objects", Applied Optics 1984; Gupta and
Nayar, "Micro Phase Shifting", CVPR 2012, sections 3 and 4 (N + 2 images for N frequencies).
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from stage.model import Finite, Positive, Strict
from stage.patterns.base import Axis, Index, Steps, check_index

TURN = 2 * np.pi
FULL_STEPS = 3
"""Number of frames of different shifts that determine a phase without other periods."""
JOINT = (((16.0, 18.0, 21.0), 1008), ((16.0, 18.0, 22.0), 1280), ((16.0, 22.0, 26.0), 2048), ((16.0, 17.0, 19.0), 4096))
"""Sets of periods and the projector width that they serve. At it, the phases of two places differ by 0.6, 0.5, 0.4 and 0.28 radians
(root sum of squares) at least; 16, 22, 26 repeat after 2288 pixels, 16, 18, 22 after 1584, 16, 17, 19 after 5168."""
MICRO_BAND = 0.15
"""Micro phase shifting keeps its periods within this part of their mean: near enough that one offset and amplitude serve all."""
MICRO_TRIALS = 400
"""Number of sets of periods that are tried; more improve the distance between codes by a few per cent."""


class PhasePattern(Strict):
    """One shift of a wave along the axis: (1 + cos(2πu/P + offset - 2πi/N))/2."""

    code: Literal["phase"]
    """The code."""
    axis: Axis
    """The axis of the projector along which the code varies."""
    period_px: Positive
    """The period P in projector pixels."""
    step: Index
    """The shift i of this frame, from 0 to `steps` - 1."""
    steps: Steps
    """The number N of shifts of a whole turn. Micro phase shifting shows only the first step of some periods."""
    offset_rad: Finite = 0.0
    """The phase of the wave at the outer edge of the first pixel in step 0. A sine has -π/2."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_index("step", self.step, self.steps, "steps")
        return self

    def level(self, u: np.ndarray, v: np.ndarray, extent: int) -> np.ndarray:
        """Return 0 to 1 at each place."""
        return raised_cosine(u / self.period_px - self.shift)

    @property
    def shift(self) -> float:
        """Return the shift δ of the wave cos(2πu/P - 2πδ) in turns."""
        return self.step / self.steps - self.offset_rad / TURN

    def describe(self) -> str:
        """Return a few words that name the frame."""
        offset = f", offset {self.offset_rad:g} rad" if self.offset_rad else ""
        return f"{self.axis} phase of {self.period_px:g} px, step {self.step} of {self.steps}{offset}"


class Wave(NamedTuple):
    """The frames of one period, as indices into the list of frames."""

    period_px: float
    frames: tuple[int, ...]
    shifts: tuple[float, ...]
    """The shift of each frame in turns."""


class PhaseCode(NamedTuple):
    """The phase frames of one axis, of all periods, as indices into the list of frames."""

    axis: Axis
    frames: tuple[int, ...]
    periods_px: tuple[float, ...]
    """The period of each frame."""
    shifts: tuple[float, ...]
    """The shift of each frame in turns: step / steps, without the offset of its set."""

    @property
    def name(self) -> str:
        """Return the word of the manifest."""
        return "phase"

    @property
    def waves(self) -> tuple[Wave, ...]:
        """Return the frames of each period, in the order of their first frames."""
        frames: dict[float, list[tuple[int, float]]] = {}
        for period, frame, shift in zip(self.periods_px, self.frames, self.shifts, strict=True):
            frames.setdefault(period, []).append((frame, shift))
        return tuple(Wave(period, *zip(*members, strict=True)) for period, members in frames.items())

    @property
    def micro(self) -> bool:
        """Return whether one period has all its steps and others have fewer than a phase of their own needs (Gupta and Nayar 2012)."""
        counts = [len(wave.frames) for wave in self.waves]
        return min(counts) < FULL_STEPS <= max(counts)

    @classmethod
    def collect(cls, frames: Mapping[PhasePattern, int]) -> "PhaseCode":
        """List the frames of one axis with their periods and shifts."""
        return cls(next(iter(frames)).axis, tuple(frames.values()), tuple(pattern.period_px for pattern in frames),
                   tuple(pattern.shift for pattern in frames))

    def lacks(self, white: int | None, black: int | None) -> str | None:
        """Return None: phases need no reference frames."""


def raised_cosine(turns: np.ndarray) -> np.ndarray:
    """Return (1 + cos(2π · turns)) / 2."""
    return np.asarray((1 + np.cos(2 * np.pi * turns)) / 2)


def joint_periods(extent: int) -> tuple[float, ...]:
    """Return three periods about 18 pixels whose phases at any two places of a projector are far apart."""
    for periods, covered in JOINT:
        if extent <= covered:
            return periods
    raise ValueError(f"the projector has {extent} px, the sets of three periods end at {JOINT[-1][1]}: name periods")


def phase_patterns(axis: Axis, periods_px: Sequence[float], steps: int = 4) -> tuple[PhasePattern, ...]:
    """Return every step of every period.
    `periods_px`: any number of periods, in projector pixels. `steps`: of each, 3 or more, evenly spaced."""
    if not periods_px or len(set(periods_px)) < len(periods_px):
        listed = ", ".join(f"{period:g}" for period in periods_px) or "(none)"
        raise ValueError(f"periods {listed} are not several different ones: give each once, and at least one")
    return tuple(PhasePattern(code="phase", axis=axis, period_px=period, step=step, steps=steps)
                 for period, step in product(periods_px, range(steps)))


def micro_patterns(extent: int, axis: Axis, *, periods: int = 5, mean_period_px: float = 16.0) -> tuple[PhasePattern, ...]:
    """Return the frames of micro phase shifting: three steps of the first period, one of each other; all periods short and close together.

    All frequencies are high, so light between surfaces adds the same constant to every frame; they lie close together, so
    defocus dims all alike, and one offset and one amplitude serve all frames. `extent`: projector pixels along the axis, over which no two
    places look alike. `periods`: how many, 3 or more; there are two more frames than periods. `mean_period_px`: about which the periods
    lie."""
    chosen = micro_periods(extent, periods, mean_period_px)
    first = [PhasePattern(code="phase", axis=axis, period_px=chosen[0], step=step, steps=3) for step in range(3)]
    return (*first, *(PhasePattern(code="phase", axis=axis, period_px=period, step=0, steps=3) for period in chosen[1:]))


def micro_periods(extent: int, count: int, mean_period_px: float) -> tuple[float, ...]:
    """Return periods near a mean under which the places of the projector look most unlike: the best of many fixed random sets.

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
