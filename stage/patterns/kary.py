"""k-ary codes: each frame shows one base-k digit of every stripe's number, as a grey level or a colour.

Sources: Horn and Kiryati, "Toward optimal structured light patterns", Image and Vision Computing 1999 (grey levels); Caspi, Kiryati and
Shamir, "Range imaging with adaptive color structured light", PAMI 1998 (colours).
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from stage.errors import ManifestError
from stage.model import Count, FirstFault, Positive, Rgb, Strict
from stage.patterns.base import (
    Axis,
    Index,
    Level,
    UniformPattern,
    check_agreement,
    check_index,
    digit_count,
    stripe_count,
    uniform_patterns,
)

CUBE: tuple[Rgb, ...] = ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1), (1, 0, 0))
"""Corners of the colour cube, one channel changing at a step: the digits of colour codes of more than three colours."""
PRIMARIES: tuple[Rgb, ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


class KaryPattern(Strict):
    """One base-k digit as a grey level or a colour; digit digits - 1 is most significant."""

    code: Literal["kary"]
    """The code."""
    axis: Axis
    """The axis of the projector along which the code varies."""
    base: Annotated[int, Field(ge=2)]
    """The number k of values that a digit has."""
    digit: Index
    """The digit that the frame shows: `digits` - 1 is the coarsest, 0 the finest."""
    digits: Count
    """The number of digits of the code."""
    stripe_px: Positive = 1
    """The width of the finest stripe in projector pixels."""
    reflected: bool = False
    """True if a digit t is shown as k - 1 - t where the sum of the coarser digits is odd (k-ary Gray code)."""
    levels: Annotated[tuple[Level, ...], FirstFault] | None = None
    """The light of each value of a digit, `base` of them; give these or `colors`. None: the digits are colours."""
    colors: Annotated[tuple[Rgb, ...], FirstFault] | None = None
    """The colour of each value of a digit, `base` of them; give these or `levels`. None: the digits are grey levels."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_index("digit", self.digit, self.digits, "digits")
        if (self.levels is None) == (self.colors is None):
            raise ValueError("give either levels or colors")
        name, values = ("levels", self.levels) if self.levels is not None else ("colors", self.colors)
        if values is not None and len(values) != self.base:
            raise ValueError(f"{name} has {len(values)} entries, base is {self.base}: give one for each digit value")
        return self

    def level(self, u: np.ndarray, v: np.ndarray, extent: int) -> np.ndarray:
        """Return the grey level of each place or, with another dimension, its colour."""
        number = np.floor(u / self.stripe_px).astype(np.int64)
        digit = digits_of(number, self.base, self.digits, reflected=self.reflected)[self.digit]
        return np.asarray(np.array(self.levels if self.levels is not None else self.colors, dtype=np.float64)[digit])

    def describe(self) -> str:
        """Return a few words that name the frame."""
        return f"{self.axis} {self.code} digit {self.digit} of {self.digits}"


class KaryCode(NamedTuple):
    """The base-k frames of one axis, as indices into the list of frames."""

    axis: Axis
    base: int
    stripe_px: float
    reflected: bool
    levels: tuple[float, ...] | None
    colors: tuple[Rgb, ...] | None
    frames: tuple[int, ...]
    """The frame of each digit, digit 0 (the finest) first."""

    @property
    def name(self) -> str:
        """Return the word of the manifest."""
        return "kary"

    @property
    def stripe_count(self) -> int:
        """Return how many stripes the code numbers: the projector shows as many or fewer."""
        return self.base**len(self.frames)

    def without(self, digits: int) -> "KaryCode":
        """Return the code of wider stripes that is left without so many of the finest digits."""
        return self._replace(frames=self.frames[digits:], stripe_px=self.stripe_px * self.base**digits)

    @classmethod
    def collect(cls, frames: Mapping[KaryPattern, int]) -> "KaryCode":
        """Sort the frames of one code by digit."""
        one = next(iter(frames))
        check_agreement(frames, ("base", "digits", "stripe_px", "reflected", "levels", "colors"))
        found = {pattern.digit: index for pattern, index in frames.items()}
        for digit in range(one.digits):
            if digit not in found:
                raise ManifestError(f"the {one.axis} kary code of {one.digits} digits has no frame of digit {digit}: "
                                    "project it, or declare fewer digits")
        return cls(one.axis, one.base, one.stripe_px, one.reflected, one.levels, one.colors,
                   tuple(found[digit] for digit in range(one.digits)))

    def lacks(self, white: int | None, black: int | None) -> str | None:
        """Return what is missing to decode the code, as a sentence; None if nothing is."""
        if white is not None and black is not None:
            return None
        return f"the {self.axis} kary code needs a white and a black frame: give both"


def digits_of(code: np.ndarray, base: int, digits: int, *, reflected: bool) -> np.ndarray:
    """Return base-k digits, least significant first.
    `digits`: how many; more significant ones are cut off. `reflected`: a digit t becomes k - 1 - t where the more significant digits, as
    shown, add up to an odd number: neighbours then differ in one digit, by one (k-ary Gray code). With odd k the plain digits above add up
    to odd at the same time. Returns [digits, ...]."""
    plain = np.stack([code // base**d % base for d in range(digits)])
    if not reflected:
        return plain
    higher = np.zeros_like(code)
    shown = np.empty_like(plain)
    for digit in reversed(range(digits)):
        shown[digit] = np.where(higher % 2 == 1, base - 1 - plain[digit], plain[digit])
        higher = higher + shown[digit]
    return shown


def number_of(shown: np.ndarray, base: int, *, reflected: bool) -> np.ndarray:
    """Return the numbers [...] that base-k digits [digits, ...] spell, least significant first: the inverse of `digits_of`."""
    number, higher = np.zeros_like(shown[0]), np.zeros_like(shown[0])
    for digit in reversed(shown):
        number = number * base + (np.where(higher % 2 == 1, base - 1 - digit, digit) if reflected else digit)
        higher = higher + digit
    return number


def kary_patterns(
    extent: int, axis: Axis, *, base: int,
    reflected: bool = True,  # k-ary Gray code, in which neighbouring stripes differ in one digit by one
    stripe_px: float = 1,
    levels: Sequence[float] | None = None,  # [k] grey level of each digit value, linear light; None (and no colors): even steps from 0 to 1
    colors: Sequence[Rgb] | None = None,  # [k] colour of each digit value, in place of levels
) -> tuple[KaryPattern | UniformPattern, ...]:
    """Return the frames of base-k digits, most significant first, then white and black, without which levels cannot be told."""
    if levels is None and colors is None:
        levels = [value / max(base - 1, 1) for value in range(base)]
    digits = digit_count(stripe_count(extent, stripe_px), base)
    frames = [KaryPattern(code="kary", axis=axis, base=base, digit=digit, digits=digits, stripe_px=stripe_px, reflected=reflected,
                          levels=None if levels is None else tuple(levels), colors=None if colors is None else tuple(colors))
              for digit in reversed(range(digits))]
    return (*frames, *uniform_patterns())


def palette(base: int) -> tuple[Rgb, ...]:
    """Return colours far apart for so many digit values: red, green, blue; for other counts corners of the colour cube."""
    if not 2 <= base <= len(CUBE):
        raise ValueError(f"{base} colours are not told apart by a palette: choose 2 to {len(CUBE)}, or give colors")
    return PRIMARIES if base == 3 else CUBE[:base]
