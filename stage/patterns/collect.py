"""Which frames of a capture make up one code: the manifest's entries, in any order, sorted into what decoders take."""

from collections.abc import Sequence
from typing import NamedTuple

from stage.errors import ManifestError
from stage.model import Rgb
from stage.pattern import Axis, BinaryPattern, KaryPattern, ModulatedPattern, Pattern, PhasePattern, RampPattern, UniformPattern, XorPattern


class BinaryCode(NamedTuple):
    """Binary, Gray or XOR frames of one axis; numbers are places in the list of frames."""

    code: str
    """binary, gray or xor"""
    axis: Axis
    stripe_px: float
    base_bit: int
    """Of xor; else 0."""
    frames: tuple[int, ...]
    """Frame of each bit, bit 0 (the finest) first."""
    inverses: tuple[int, ...] | None
    """Frame of each inverse; None without them."""


class KaryCode(NamedTuple):
    """Base-k frames of one axis."""

    axis: Axis
    base: int
    stripe_px: float
    reflected: bool
    levels: tuple[float, ...] | None
    colors: tuple[Rgb, ...] | None
    frames: tuple[int, ...]
    """Frame of each digit, digit 0 (the finest) first."""


class RampCode(NamedTuple):
    """Ramps of one axis; one of them may be missing."""

    axis: Axis
    up: int | None
    down: int | None


class PhaseCode(NamedTuple):
    """Phase frames of one axis, of all periods."""

    axis: Axis
    frames: tuple[int, ...]
    periods_px: tuple[float, ...]
    """Of each frame."""
    shifts: tuple[float, ...]
    """Of each frame, turns: step / steps."""


class ModulatedCode(NamedTuple):
    """Modulated phase frames of one axis and one period."""

    axis: Axis
    period_px: float
    frames: tuple[tuple[int, ...], ...]
    """[steps][carrier steps]"""


Code = BinaryCode | KaryCode | RampCode | PhaseCode | ModulatedCode


class Collected(NamedTuple):
    """The codes of a capture."""

    codes: tuple[Code, ...]
    white: int | None
    black: int | None

    def of_axis(self, axis: Axis) -> tuple[Code, ...]:
        """The codes along one axis, in the order of their first frames."""
        return tuple(code for code in self.codes if code.axis == axis)


def collect(patterns: Sequence[Pattern | None]) -> Collected:
    """Sort frames into codes.

    Args:
        patterns: the entry of each frame; None for frames that are something else.

    Returns:
        The codes, complete.

    Raises:
        ManifestError: two frames show one pattern, a bit or digit or its inverse is missing, or the frames of one code disagree
            about their stripes; the message names it.
    """
    first: dict[Pattern, int] = {}
    for index, pattern in enumerate(patterns):
        if pattern is None:
            continue
        if pattern in first:
            raise ManifestError(f"frames {first[pattern]} and {index} show one pattern ({describe(pattern)}): keep one, or their mean")
        first[pattern] = index
    groups: dict[tuple[object, ...], list[tuple[Pattern, int]]] = {}
    for pattern, index in first.items():
        if not isinstance(pattern, UniformPattern):
            key = (pattern.code, pattern.axis, pattern.period_px if isinstance(pattern, ModulatedPattern) else None)
            groups.setdefault(key, []).append((pattern, index))
    white, black = (next((index for pattern, index in first.items() if pattern.code == name), None) for name in ("white", "black"))
    return Collected(tuple(_code(group) for group in groups.values()), white, black)


def describe(pattern: Pattern) -> str:
    """A few words that name one frame's pattern."""
    match pattern:
        case UniformPattern():
            return pattern.code
        case RampPattern():
            return f"{pattern.axis} ramp {pattern.direction}"
        case PhasePattern():
            return f"{pattern.axis} phase of {pattern.period_px:g} px, step {pattern.step} of {pattern.steps}"
        case ModulatedPattern():
            return (f"{pattern.axis} modulated phase of {pattern.period_px:g} px, step {pattern.step} of {pattern.steps}, "
                    f"carrier step {pattern.carrier_step} of {pattern.carrier_steps}")
        case KaryPattern():
            return f"{pattern.axis} {pattern.code} digit {pattern.digit} of {pattern.digits}"
    return f"{pattern.axis} {pattern.code} bit {pattern.bit} of {pattern.bits}{', inverse' if pattern.inverse else ''}"


def _code(group: list[tuple[Pattern, int]]) -> Code:
    one = group[0][0]
    axis = getattr(one, "axis")  # noqa: B009 - uniform frames, which have none, are not in a group
    if isinstance(one, BinaryPattern | XorPattern):
        fine = [(pattern, index) for pattern, index in group if isinstance(pattern, BinaryPattern | XorPattern)]
        _agree([pattern for pattern, _ in fine], ("bits", "stripe_px", "base_bit"))
        frames, inverses = ({pattern.bit: index for pattern, index in fine if pattern.inverse == inverse} for inverse in (False, True))
        missing = [bit for bit in range(one.bits) if bit not in frames]
        if missing:
            raise ManifestError(f"the {axis} {one.code} code of {one.bits} bits has no frame of bit {missing[0]}: "
                                "project it, or declare fewer bits")
        odd = [bit for bit in range(one.bits) if inverses and bit not in inverses]
        if odd:
            raise ManifestError(f"the {axis} {one.code} code has inverses, but none of bit {odd[0]}: give all, or none")
        return BinaryCode(one.code, axis, one.stripe_px, getattr(one, "base_bit", 0), _in_order(frames),
                          _in_order(inverses) if inverses else None)
    if isinstance(one, KaryPattern):
        digits = [(pattern, index) for pattern, index in group if isinstance(pattern, KaryPattern)]
        _agree([pattern for pattern, _ in digits], ("base", "digits", "stripe_px", "reflected", "levels", "colors"))
        found = {pattern.digit: index for pattern, index in digits}
        gone = [digit for digit in range(one.digits) if digit not in found]
        if gone:
            raise ManifestError(f"the {axis} kary code of {one.digits} digits has no frame of digit {gone[0]}: "
                                "project it, or declare fewer digits")
        return KaryCode(axis, one.base, one.stripe_px, one.reflected, one.levels, one.colors, _in_order(found))
    if isinstance(one, RampPattern):
        ramps = {pattern.direction: index for pattern, index in group if isinstance(pattern, RampPattern)}
        return RampCode(axis, ramps.get("up"), ramps.get("down"))
    if isinstance(one, PhasePattern):
        waves = [(pattern, index) for pattern, index in group if isinstance(pattern, PhasePattern)]
        return PhaseCode(axis, tuple(index for _, index in waves), tuple(pattern.period_px for pattern, _ in waves),
                         tuple(pattern.step / pattern.steps for pattern, _ in waves))
    assert isinstance(one, ModulatedPattern)
    lit = [(pattern, index) for pattern, index in group if isinstance(pattern, ModulatedPattern)]
    _agree([pattern for pattern, _ in lit], ("steps", "carrier_steps", "carrier_period_px"))
    grid = {(pattern.step, pattern.carrier_step): index for pattern, index in lit}
    for step in range(one.steps):
        for carrier in range(one.carrier_steps):
            if (step, carrier) not in grid:
                raise ManifestError(f"the {axis} modulated phase of {one.period_px:g} px has no frame of step {step}, "
                                    f"carrier step {carrier}: project it")
    return ModulatedCode(axis, one.period_px, tuple(tuple(grid[step, carrier] for carrier in range(one.carrier_steps))
                                                    for step in range(one.steps)))


def _agree(patterns: Sequence[Pattern], fields: tuple[str, ...]) -> None:
    for field in fields:
        values = [getattr(pattern, field, None) for pattern in patterns]
        other = next((value for value in values if value != values[0]), None)
        if other is not None:
            raise ManifestError(f"frames of the {getattr(patterns[0], 'axis', '')} {patterns[0].code} code disagree about {field} "
                                f"({values[0]} and {other}): one axis of a capture has one such code")


def _in_order(frames: dict[int, int]) -> tuple[int, ...]:
    return tuple(frames[number] for number in sorted(frames))
