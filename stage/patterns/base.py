"""Parts that all codes share: the axis along which a code varies, uniform frames, and how many digits number the stripes."""

from collections.abc import Iterable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from stage.errors import ManifestError
from stage.model import Strict

Axis = Literal["column", "row"]
Index = Annotated[int, Field(ge=0)]
Level = Annotated[float, Field(ge=0, le=1)]
Steps = Annotated[int, Field(ge=3)]
"""Number of shifts of a wave; its three unknowns (offset, amplitude, phase) need three."""


class UniformPattern(Strict):
    """Projector black (ambient) or full on."""

    code: Literal["black", "white"]
    """`black`: ambient light and what the projector gives for black; `white`: all pixels on."""

    def level(self, u: np.ndarray, v: np.ndarray, extent: int) -> np.ndarray:
        """Return one level everywhere."""
        return np.full(np.shape(u), 1.0 if self.code == "white" else 0.0)

    def describe(self) -> str:
        """Return black or white."""
        return self.code


def uniform_patterns() -> tuple[UniformPattern, UniformPattern]:
    """Return the white and the black frame, from which decoders learn how bright each pixel can be."""
    return UniformPattern(code="white"), UniformPattern(code="black")


def digit_count(stripes: int, base: int) -> int:
    """Return how many digits in base k number the stripes from 0; at least one."""
    if stripes < 1 or base < 2:
        raise ValueError(f"{stripes} stripes in base {base} cannot be numbered: give at least one stripe and base 2")
    digits = 1
    while base**digits < stripes:
        digits += 1
    return digits


def stripe_count(extent: int, stripe_px: float) -> int:
    """Return how many stripes, whole or begun, cover `extent` projector pixels."""
    if not stripe_px > 0:
        raise ValueError(f"stripes of {stripe_px:g} px have no width: give more than 0")
    return int(-(-extent // stripe_px))


def check_index(name: str, value: int, count: int, unit: str) -> None:
    """Refuse the number of a bit, digit or step that lies beyond the last one."""
    if value >= count:
        raise ValueError(f"{name} {value} does not exist in {count} {unit} (0 to {count - 1})")


def check_agreement(patterns: Iterable[Any], fields: tuple[str, ...]) -> None:
    """Refuse frames of one code whose manifest entries disagree about these fields."""
    first, *others = patterns
    for field in fields:
        for other in others:
            if getattr(other, field) != getattr(first, field):
                raise ManifestError(f"frames of the {first.axis} {first.code} code disagree about {field} "
                                    f"({getattr(first, field)} and {getattr(other, field)}): one axis of a capture has one such code")
