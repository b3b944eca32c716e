"""Intensity ratio: a ramp of light and its opposite, whose ratio is the projector's coordinate whatever the surface reflects.

Source: Carrihill and Hummel, "Experiments with the intensity ratio depth sensor", CVGIP 1985.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from stage.model import Strict
from stage.patterns.base import Axis, UniformPattern, uniform_patterns


class RampPattern(Strict):
    """u / width, or 1 - u / width: with its opposite or white, the intensity-ratio pair."""

    code: Literal["ramp"]
    """The code."""
    axis: Axis
    """The axis of the projector along which the code varies."""
    direction: Literal["up", "down"]
    """The direction along the axis in which the light rises."""

    def level(self, u: np.ndarray, v: np.ndarray, extent: int) -> np.ndarray:
        """Return 0 to 1 at each place."""
        return u / extent if self.direction == "up" else 1 - u / extent

    def describe(self) -> str:
        """Return a few words that name the frame."""
        return f"{self.axis} ramp {self.direction}"


class RampCode(NamedTuple):
    """The ramps of one axis, as indices into the list of frames; one of them may be missing."""

    axis: Axis
    up: int | None
    down: int | None

    @property
    def name(self) -> str:
        """Return the word of the manifest."""
        return "ramp"

    @classmethod
    def collect(cls, frames: Mapping[RampPattern, int]) -> "RampCode":
        """Sort the frames of one code by direction."""
        found = {pattern.direction: index for pattern, index in frames.items()}
        return cls(next(iter(frames)).axis, found.get("up"), found.get("down"))

    def lacks(self, white: int | None, black: int | None) -> str | None:
        """Return what is missing to decode the code, as a sentence; None if nothing is."""
        if white is not None or (self.up is not None and self.down is not None):
            return None
        return f"the {self.axis} ramp needs its opposite or a white frame: give one"


def ramp_patterns(axis: Axis) -> tuple[RampPattern | UniformPattern, ...]:
    """Return the ramp up and the ramp down, then white and black."""
    return (RampPattern(code="ramp", axis=axis, direction="up"), RampPattern(code="ramp", axis=axis, direction="down"),
            *uniform_patterns())
