"""The strict base of every manifest model: unknown keys are errors, numbers are finite, values are frozen."""

import math
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


class Strict(BaseModel):
    """A frozen record whose unknown keys are errors that name the key."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _unit(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    largest = max(abs(c) for c in vector)
    if largest == 0.0:
        raise ValueError("has zero length: give a direction")
    scaled = [math.ldexp(c, -math.frexp(largest)[1]) for c in vector]  # exactly, so that no square is beyond what a float holds
    length = math.sqrt(sum(c * c for c in scaled))
    x, y, z = (c / length for c in scaled)
    return (x, y, z)


def _lit(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    if max(colour) == 0:
        raise ValueError("is zero in every channel: a light gives light; use {\"type\": \"off\"} for ambient frames")
    return colour


def _not_blank(text: str) -> str:
    if not text.strip():
        raise ValueError("is blank")
    return text


FirstFault = Field(fail_fast=True)
"""Of a list that may be long, the first fault is told alone: those of a million entries would fill the memory."""
Text = Annotated[str, AfterValidator(_not_blank)]
"""A name: anything but nothing."""
Vector = tuple[float, float, float]
Direction = Annotated[Vector, AfterValidator(_unit)]
"""Given with any length above zero, kept with length one."""
NotNegative = Annotated[float, Field(ge=0)]
Rgb = tuple[NotNegative, NotNegative, NotNegative]
"""Red, green, blue; none negative."""
LitRgb = Annotated[Rgb, AfterValidator(_lit)]
"""Not zero in every channel either: what a light of its own gives."""
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Resolution = tuple[Count, Count]
"""Width, height in pixels."""
