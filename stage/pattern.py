"""Projected patterns as the manifest declares them: what the projector showed in one frame."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stage.model import Count, Positive, Rgb, Strict

Axis = Literal["column", "row"]
Index = Annotated[int, Field(ge=0)]
Level = Annotated[float, Field(ge=0, le=1)]


class BinaryPattern(Strict):
    """One bit of the code floor(u / stripe_px); gray: of c XOR (c >> 1). Bit bits - 1 is the coarsest."""

    code: Literal["binary", "gray"]
    axis: Axis
    bit: Index
    bits: Count
    stripe_px: Positive = 1
    inverse: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.bit >= self.bits:
            raise ValueError(f"bit {self.bit} does not exist in {self.bits} bits (0 to {self.bits - 1})")
        return self


class KaryPattern(Strict):
    """One base-k digit as a grey level or a colour; digit digits - 1 is most significant."""

    code: Literal["kary"]
    axis: Axis
    base: Annotated[int, Field(ge=2)]
    digit: Index
    digits: Count
    stripe_px: Positive = 1
    reflected: bool = False
    levels: tuple[Level, ...] | None = None
    colors: tuple[Rgb, ...] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.digit >= self.digits:
            raise ValueError(f"digit {self.digit} does not exist in {self.digits} digits (0 to {self.digits - 1})")
        if (self.levels is None) == (self.colors is None):
            raise ValueError("give either levels or colors")
        name, values = ("levels", self.levels) if self.levels is not None else ("colors", self.colors)
        if values is not None and len(values) != self.base:
            raise ValueError(f"{name} has {len(values)} entries, base is {self.base}: give one for each digit value")
        return self


class RampPattern(Strict):
    """u / width, or 1 - u / width: with its opposite or white, the intensity-ratio pair."""

    code: Literal["ramp"]
    axis: Axis
    direction: Literal["up", "down"]


class PhasePattern(Strict):
    """(1 + cos(2πu/P - 2πi/N))/2."""

    code: Literal["phase"]
    axis: Axis
    period_px: Positive
    step: Index
    steps: Annotated[int, Field(ge=3)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.step >= self.steps:
            raise ValueError(f"step {self.step} does not exist in {self.steps} steps (0 to {self.steps - 1})")
        return self


class UniformPattern(Strict):
    """Projector black (ambient) or full on."""

    code: Literal["black", "white"]


Pattern = Annotated[BinaryPattern | KaryPattern | RampPattern | PhasePattern | UniformPattern, Field(discriminator="code")]
"""Any of the pattern codes, told apart by `code`."""
