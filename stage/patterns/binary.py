"""Binary, Gray and XOR codes: each frame shows one bit of every stripe's number.

Sources: Posdamer and Altschuler, "Surface measurement by space-encoded projected beam systems", CGIP 1982 (binary); Gray, US patent
2632058 (Gray code); Gupta, Agrawal, Veeraraghavan and Narasimhan, "Structured light 3D scanning in the presence of global
illumination", CVPR 2011, section 4 (XOR).
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from stage.errors import ManifestError
from stage.model import Count, Positive, Strict
from stage.patterns.base import Axis, Index, UniformPattern, check_agreement, check_index, digit_count, stripe_count, uniform_patterns


class _BitPattern(Strict):
    """One bit of a number that every stripe has."""

    code: Literal["binary", "gray", "xor"]
    """The code."""
    axis: Axis
    """The axis of the projector along which the code varies."""
    bit: Index
    """The bit that the frame shows: `bits` - 1 is the coarsest, 0 the finest."""
    bits: Count
    """The number of bits of the code."""
    stripe_px: Positive = 1
    """The width of the finest stripe in projector pixels."""
    inverse: bool = False
    """True if black and white are exchanged."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_index("bit", self.bit, self.bits, "bits")
        return self

    def describe(self) -> str:
        """Return a few words that name the frame."""
        return f"{self.axis} {self.code} bit {self.bit} of {self.bits}{', inverse' if self.inverse else ''}"


class BinaryPattern(_BitPattern):
    """One bit of the code floor(u / stripe_px); gray: of c XOR (c >> 1). Bit bits - 1 is the coarsest."""

    code: Literal["binary", "gray"]
    """The code: the number of the stripe, or its Gray code."""

    def level(self, u: np.ndarray, v: np.ndarray, extent: int) -> np.ndarray:
        """Return 0 or 1 at each place."""
        number = np.floor(u / self.stripe_px).astype(np.int64)
        word = gray_of(number) if self.code == "gray" else number
        return (word >> self.bit & 1 ^ int(self.inverse)).astype(np.float64)


class XorPattern(_BitPattern):
    """One bit of the Gray code with bit base_bit laid over it by XOR: no stripe is wide, so that light between surfaces averages out.

    Bits above base_bit are shown as their XOR with it; base_bit and the bits below it, which are as fine, as they are. XOR-02 of
    Gupta et al. (CVPR 2011) has base bit 0, XOR-04 base bit 1.
    """

    code: Literal["xor"]
    """The code."""
    base_bit: Index = 0
    """The bit that is laid over the coarser ones."""

    @model_validator(mode="after")
    def _check_base(self) -> Self:
        check_index("base_bit", self.base_bit, self.bits, "bits")
        return self

    def level(self, u: np.ndarray, v: np.ndarray, extent: int) -> np.ndarray:
        """Return 0 or 1 at each place."""
        gray = gray_of(np.floor(u / self.stripe_px).astype(np.int64))
        bit = gray >> self.bit & 1
        if self.bit > self.base_bit:
            bit ^= gray >> self.base_bit & 1
        return (bit ^ int(self.inverse)).astype(np.float64)


class BinaryCode(NamedTuple):
    """The binary, Gray or XOR frames of one axis, as indices into the list of frames."""

    name: str
    """binary, gray or xor"""
    axis: Axis
    stripe_px: float
    base_bit: int
    """The base bit of xor; else 0."""
    frames: tuple[int, ...]
    """The frame of each bit, bit 0 (the finest) first."""
    inverses: tuple[int, ...] | None
    """The frame of each inverse; None without them."""

    @property
    def stripe_count(self) -> int:
        """Return how many stripes the code numbers: the projector shows as many or fewer."""
        return 2**len(self.frames)

    def without(self, bits: int) -> "BinaryCode":
        """Return the code of wider stripes that is left without so many of the finest bits, if none is laid over others."""
        return self._replace(frames=self.frames[bits:], inverses=None if self.inverses is None else self.inverses[bits:],
                             stripe_px=self.stripe_px * 2**bits)

    @classmethod
    def collect(cls, frames: Mapping[BinaryPattern | XorPattern, int]) -> "BinaryCode":
        """Sort the frames of one code by bit."""
        one = next(iter(frames))
        check_agreement(frames, ("bits", "stripe_px", *(("base_bit",) if one.code == "xor" else ())))
        plain, inverses = ({pattern.bit: index for pattern, index in frames.items() if pattern.inverse == inverse}
                           for inverse in (False, True))
        for bit in range(one.bits):
            if bit not in plain:
                raise ManifestError(f"the {one.axis} {one.code} code of {one.bits} bits has no frame of bit {bit}: "
                                    "project it, or declare fewer bits")
            if inverses and bit not in inverses:
                raise ManifestError(f"the {one.axis} {one.code} code has inverses, but none of bit {bit}: give all, or none")
        return cls(one.code, one.axis, one.stripe_px, getattr(one, "base_bit", 0), tuple(plain[bit] for bit in range(one.bits)),
                   tuple(inverses[bit] for bit in range(one.bits)) if inverses else None)

    def lacks(self, white: int | None, black: int | None) -> str | None:
        """Return what is missing to decode the code, as a sentence; None if nothing is."""
        if self.inverses is not None or (white is not None and black is not None):
            return None
        return (f"the {self.axis} {self.name} code has neither inverses nor a white and a black frame, and no phases tell what these show: "
                "give one of the three")


def gray_of(code: np.ndarray) -> np.ndarray:
    """Return the reflected binary code (Gray, US patent 2632058) of whole numbers."""
    return code ^ (code >> 1)


def binary_patterns(extent: int, axis: Axis, *, code: Literal["binary", "gray"] = "gray", stripe_px: float = 1, inverses: bool = True,
                    references: bool = True) -> tuple[BinaryPattern | UniformPattern, ...]:
    """Return the frames of a binary or Gray code, coarsest bit first, each followed by its inverse, then white and black (OpenCV's order).
    `stripe_px`: width of the finest stripe. `inverses`: with each frame its inverse, which gives every pixel a threshold of its own.
    `references`: with white and black."""
    bits = digit_count(stripe_count(extent, stripe_px), 2)
    frames = [BinaryPattern(code=code, axis=axis, bit=bit, bits=bits, stripe_px=stripe_px, inverse=inverse)
              for bit in reversed(range(bits)) for inverse in ((False, True) if inverses else (False,))]
    return (*frames, *(uniform_patterns() if references else ()))


def xor_patterns(extent: int, axis: Axis, *, base_bit: int = 0, stripe_px: float = 1,
                 inverses: bool = True) -> tuple[XorPattern | UniformPattern, ...]:
    """Return the frames of a Gray code in stripes that are all narrow, for scenes whose surfaces light each other.
    `base_bit`: 0 for XOR-02 (no stripe wider than two finest ones), 1 for XOR-04."""
    bits = digit_count(stripe_count(extent, stripe_px), 2)
    if not 0 <= base_bit < bits:
        raise ValueError(f"base bit {base_bit} does not exist in {bits} bits (0 to {bits - 1})")
    frames = [XorPattern(code="xor", axis=axis, bit=bit, bits=bits, base_bit=base_bit, stripe_px=stripe_px, inverse=inverse)
              for bit in reversed(range(bits)) for inverse in ((False, True) if inverses else (False,))]
    return (*frames, *uniform_patterns())
