"""The base class of all models that are read from JSON, and the types of their fields; limits on names.

A name has no control characters, no halves of characters, and a largest length: a NUL ends a path in the system's calls and cannot be
stored by PostgreSQL, half a character cannot be written as UTF-8, and control characters change what a terminal or a log shows.
"""

import math
import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

REFUSED = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
"""The characters of the Unicode categories Cc (control) and Cs (surrogate)."""

MAX_CHARACTERS = 1000
"""The most characters of a name: file systems take 255 bytes between two slashes, and lists of captures repeat their names."""


class Strict(BaseModel):
    """A frozen model in which an unknown key and a number that is not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


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


def _in_line(text: str) -> str:
    if (fault := name_fault(text)) is not None:
        raise ValueError(fault)
    return text


def _not_blank(text: str) -> str:
    if not text.strip():
        raise ValueError("is blank")
    return text


FirstFault = Field(fail_fast=True)
"""Marks a list that may be long: only its first fault is reported, because the faults of a million entries fill the memory."""
Line = Annotated[str, AfterValidator(_in_line)]
"""A text that `name_fault` finds no fault with. Every text that is read from a file or a request is one."""
Text = Annotated[Line, AfterValidator(_not_blank)]
"""A text that is not blank."""
Vector = tuple[float, float, float]
"""The x, y and z of a point or a direction."""
Direction = Annotated[Vector, AfterValidator(_unit)]
"""A vector of any length above zero, which is normalised to length one."""
Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Rgb = tuple[NotNegative, NotNegative, NotNegative]
"""Red, green and blue, none of them negative."""
LitRgb = Annotated[Rgb, AfterValidator(_lit)]
"""The colour of a light: red, green and blue, none of them negative and not all of them zero."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
"""A number from 0 to 1."""
Count = Annotated[int, Field(ge=1)]
NotNegativeCount = Annotated[int, Field(ge=0)]
Resolution = tuple[Count, Count]
"""The width and height of an image in pixels."""


def name_fault(text: str) -> str | None:
    """Return why a text cannot be a name, as in `has a control character (U+0000): leave it out`; None if it can."""
    if len(text) > MAX_CHARACTERS:
        return f"has {len(text)} characters: give {MAX_CHARACTERS} or fewer"
    found = REFUSED.search(text)
    if found is None:
        return None
    code = ord(found[0])
    return f"has {'a control character' if code < 0xD800 else 'half a character'} (U+{code:04X}): leave it out"
