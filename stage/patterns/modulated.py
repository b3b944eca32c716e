"""Modulated phase shifting: a long period that needs no unwrapping, under a fine carrier across it that tells direct light apart.

Source: Chen, Seidel and Lensch, "Modulated phase-shifting for 3D scanning", CVPR 2008.
"""

from collections.abc import Mapping
from itertools import product
from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from stage.errors import ManifestError
from stage.model import Finite, Positive, Strict
from stage.patterns.base import Axis, Index, Steps, check_agreement, check_index
from stage.patterns.phase import TURN, raised_cosine


class ModulatedPattern(Strict):
    """A phase frame under a fine carrier across it: (1 + cos(2πu/P + offset - 2πi/N))/2 · (1 + cos(2πv/Q - 2πj/M))/2.

    Chen, Seidel and Lensch, "Modulated phase-shifting for 3D scanning", CVPR 2008: what varies with the carrier is direct light.
    """

    code: Literal["modulated"]
    """The code."""
    axis: Axis
    """The axis of the projector along which the code varies."""
    period_px: Positive
    """The period P along the axis in projector pixels."""
    step: Index
    """The shift i of this frame, from 0 to `steps` - 1."""
    steps: Steps
    """The number N of shifts."""
    carrier_period_px: Positive
    """The period Q of the carrier, across the axis, in projector pixels."""
    carrier_step: Index
    """The shift j of the carrier in this frame, from 0 to `carrier_steps` - 1."""
    carrier_steps: Steps
    """The number M of shifts of the carrier."""
    offset_rad: Finite = 0.0
    """The phase of the wave at the outer edge of the first pixel in step 0; the same in every frame of a period. A sine has -π/2."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_index("step", self.step, self.steps, "steps")
        check_index("carrier_step", self.carrier_step, self.carrier_steps, "steps")
        return self

    def level(self, u: np.ndarray, v: np.ndarray, extent: int) -> np.ndarray:
        """Return 0 to 1 at each place."""
        return raised_cosine(u / self.period_px - self.step / self.steps + self.offset_rad / TURN) * raised_cosine(
            v / self.carrier_period_px - self.carrier_step / self.carrier_steps)

    def describe(self) -> str:
        """Return a few words that name the frame."""
        return (f"{self.axis} modulated phase of {self.period_px:g} px, step {self.step} of {self.steps}, "
                f"carrier step {self.carrier_step} of {self.carrier_steps}")


class ModulatedCode(NamedTuple):
    """The modulated phase frames of one axis and one period, as indices into the list of frames."""

    axis: Axis
    period_px: float
    frames: tuple[tuple[int, ...], ...]
    """[steps][carrier steps]"""
    offset_rad: float = 0.0
    """The phase of the wave at the outer edge of the first pixel in step 0."""

    @property
    def name(self) -> str:
        """Return the word of the manifest."""
        return "modulated"

    @classmethod
    def collect(cls, frames: Mapping[ModulatedPattern, int]) -> "ModulatedCode":
        """Sort the frames of one period by step and carrier step."""
        one = next(iter(frames))
        check_agreement(frames, ("steps", "carrier_steps", "carrier_period_px", "offset_rad"))
        grid = {(pattern.step, pattern.carrier_step): index for pattern, index in frames.items()}
        for step, carrier in product(range(one.steps), range(one.carrier_steps)):
            if (step, carrier) not in grid:
                raise ManifestError(f"the {one.axis} modulated phase of {one.period_px:g} px has no frame of step {step}, "
                                    f"carrier step {carrier}: project it")
        return cls(one.axis, one.period_px, tuple(tuple(grid[step, carrier] for carrier in range(one.carrier_steps))
                                                  for step in range(one.steps)), one.offset_rad)

    def lacks(self, white: int | None, black: int | None) -> str | None:
        """Return None: phases need no reference frames."""


def modulated_patterns(axis: Axis, period_px: float, *, steps: int = 4, carrier_period_px: float = 8.0,
                       carrier_steps: int = 3) -> tuple[ModulatedPattern, ...]:
    """Return every step of the long period at every step of the carrier along the other axis."""
    return tuple(ModulatedPattern(code="modulated", axis=axis, period_px=period_px, step=step, steps=steps,
                                  carrier_period_px=carrier_period_px, carrier_step=carrier, carrier_steps=carrier_steps)
                 for step, carrier in product(range(steps), range(carrier_steps)))
