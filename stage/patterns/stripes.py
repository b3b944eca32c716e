"""Frames that number stripes: binary and Gray codes, XOR codes, base-k digits as grey levels or colours."""

from collections.abc import Sequence
from typing import Literal

from stage.model import Rgb
from stage.pattern import Axis, BinaryPattern, KaryPattern, Pattern, UniformPattern, XorPattern

CUBE: tuple[Rgb, ...] = ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1), (1, 0, 0))
"""Corners of the colour cube, one channel changing at a step: the digits of colour codes of more than three colours."""
PRIMARIES: tuple[Rgb, ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def digit_count(stripes: int, base: int) -> int:
    """Digits in base k that stripes numbered from 0 need; at least one.

    Raises:
        ValueError: no stripe, or a base under 2.
    """
    if stripes < 1 or base < 2:
        raise ValueError(f"{stripes} stripes in base {base} cannot be numbered: give at least one stripe and base 2")
    digits = 1
    while base**digits < stripes:
        digits += 1
    return digits


def stripe_count(extent: int, stripe_px: float) -> int:
    """Stripes, whole or begun, over so many projector pixels.

    Raises:
        ValueError: a stripe of zero width or less.
    """
    if not stripe_px > 0:
        raise ValueError(f"stripes of {stripe_px:g} px have no width: give more than 0")
    return int(-(-extent // stripe_px))


def binary_patterns(extent: int, axis: Axis, *, code: Literal["binary", "gray"] = "gray", stripe_px: float = 1,
                    inverses: bool = True, references: bool = True) -> tuple[Pattern, ...]:
    """Binary or Gray code, coarsest bit first, each followed by its inverse, then white and black: OpenCV's order.

    Args:
        extent: projector pixels along the axis.
        axis: of the code.
        code: which.
        stripe_px: width of the finest stripe.
        inverses: with each frame its inverse, which gives every pixel a threshold of its own.
        references: with white and black.
    """
    bits = digit_count(stripe_count(extent, stripe_px), 2)
    frames: list[Pattern] = [BinaryPattern(code=code, axis=axis, bit=bit, bits=bits, stripe_px=stripe_px, inverse=inverse)
                             for bit in reversed(range(bits)) for inverse in ((False, True) if inverses else (False,))]
    return (*frames, *(uniform_patterns() if references else ()))


def xor_patterns(extent: int, axis: Axis, *, base_bit: int = 0, stripe_px: float = 1, inverses: bool = True,
                 references: bool = True) -> tuple[Pattern, ...]:
    """Gray code in stripes that are all narrow, for scenes whose surfaces light each other.

    Args:
        extent: projector pixels along the axis.
        axis: of the code.
        base_bit: 0 for XOR-02 (no stripe wider than two finest ones), 1 for XOR-04.
        stripe_px: width of the finest stripe.
        inverses: with each frame its inverse.
        references: with white and black.

    Raises:
        ValueError: no such bit.

    Source:
        Gupta, Agrawal, Veeraraghavan, Narasimhan, "Structured light 3D scanning in the presence of global illumination", CVPR 2011,
        section 4.
    """
    bits = digit_count(stripe_count(extent, stripe_px), 2)
    if not 0 <= base_bit < bits:
        raise ValueError(f"base bit {base_bit} does not exist in {bits} bits (0 to {bits - 1})")
    frames: list[Pattern] = [XorPattern(code="xor", axis=axis, bit=bit, bits=bits, base_bit=base_bit, stripe_px=stripe_px,
                                        inverse=inverse)
                             for bit in reversed(range(bits)) for inverse in ((False, True) if inverses else (False,))]
    return (*frames, *(uniform_patterns() if references else ()))


def kary_patterns(extent: int, axis: Axis, *, base: int, reflected: bool = True, stripe_px: float = 1,
                  levels: Sequence[float] | None = None, colors: Sequence[Rgb] | None = None) -> tuple[Pattern, ...]:
    """Base-k digits, most significant first, then white and black, without which levels cannot be told.

    Args:
        extent: projector pixels along the axis.
        axis: of the code.
        base: k.
        reflected: k-ary Gray code, in which neighbouring stripes differ in one digit by one.
        stripe_px: width of the finest stripe.
        levels: [k] grey level of each digit value, linear light; None (and no colors): even steps from 0 to 1.
        colors: [k] colour of each digit value, in place of levels.

    Raises:
        ValueError: a base below 2, or levels or colours of another count.
    """
    if levels is None and colors is None:
        levels = [value / max(base - 1, 1) for value in range(base)]
    digits = digit_count(stripe_count(extent, stripe_px), base)
    frames = [KaryPattern(code="kary", axis=axis, base=base, digit=digit, digits=digits, stripe_px=stripe_px, reflected=reflected,
                          levels=None if levels is None else tuple(levels), colors=None if colors is None else tuple(colors))
              for digit in reversed(range(digits))]
    return (*frames, *uniform_patterns())


def palette(base: int) -> tuple[Rgb, ...]:
    """Colours far apart for so many digit values: red, green, blue; for other counts corners of the colour cube.

    Raises:
        ValueError: not 2 to 8.
    """
    if not 2 <= base <= len(CUBE):
        raise ValueError(f"{base} colours are not told apart by a palette: choose 2 to {len(CUBE)}, or give colors")
    return PRIMARIES if base == 3 else CUBE[:base]


def uniform_patterns() -> tuple[Pattern, ...]:
    """White, black."""
    return UniformPattern(code="white"), UniformPattern(code="black")
