"""Projected patterns as the manifest declares them: what the projector showed in one frame."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stage.model import Count, FirstFault, Positive, Rgb, Strict

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
    levels: Annotated[tuple[Level, ...], FirstFault] | None = None
    colors: Annotated[tuple[Rgb, ...], FirstFault] | None = None

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


class XorPattern(Strict):
    """One bit of the Gray code with bit base_bit laid over it by XOR: no stripe is wide, so that light between surfaces averages out.

    Bits above base_bit are shown as their XOR with it; base_bit and the bits below it, which are as fine, as they are. XOR-02 of
    Gupta et al. (CVPR 2011) has base bit 0, XOR-04 base bit 1.
    """

    code: Literal["xor"]
    axis: Axis
    bit: Index
    bits: Count
    base_bit: Index = 0
    stripe_px: Positive = 1
    inverse: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in ("bit", "base_bit"):
            if getattr(self, name) >= self.bits:
                raise ValueError(f"{name} {getattr(self, name)} does not exist in {self.bits} bits (0 to {self.bits - 1})")
        return self


class ModulatedPattern(Strict):
    """A phase frame under a fine carrier across it: (1 + cos(2πu/P - 2πi/N))/2 · (1 + cos(2πv/Q - 2πj/M))/2.

    Chen, Seidel and Lensch, "Modulated phase-shifting for 3D scanning", CVPR 2008: what varies with the carrier is direct light.
    """

    code: Literal["modulated"]
    axis: Axis
    period_px: Positive
    step: Index
    steps: Annotated[int, Field(ge=3)]
    carrier_period_px: Positive
    carrier_step: Index
    carrier_steps: Annotated[int, Field(ge=3)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name, count in (("step", self.steps), ("carrier_step", self.carrier_steps)):
            if getattr(self, name) >= count:
                raise ValueError(f"{name} {getattr(self, name)} does not exist in {count} steps (0 to {count - 1})")
        return self


class UniformPattern(Strict):
    """Projector black (ambient) or full on."""

    code: Literal["black", "white"]


Pattern = Annotated[BinaryPattern | KaryPattern | RampPattern | PhasePattern | XorPattern | ModulatedPattern | UniformPattern,
                    Field(discriminator="code")]
"""Any of the pattern codes, told apart by `code`."""
