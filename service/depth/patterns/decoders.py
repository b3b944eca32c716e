"""Decoders of structured light: which codes of a capture each one takes, and how it calls the kernels that read them.

A decoder looks at the codes of one axis and returns how it would decode the axis, or None if its frames are not there. Each is named by the
rows of the table in service/depth/patterns/codes.py.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kernels.structured.binary import FINE_BITS, decode_binary, decode_gray, decode_xor
from kernels.structured.confirm import AROUND, confirm_stripes
from kernels.structured.decoded import Decoded
from kernels.structured.edges import EDGE_ERROR, REACH, refine_edges
from kernels.structured.kary import decode_kary, expected_levels
from kernels.structured.micro import decode_micro
from kernels.structured.modulated import decode_modulated
from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import WrappedPhase, decode_phase, join_periods, weights
from kernels.structured.ramp import decode_ramp
from kernels.structured.response import light_of, wave_error
from kernels.structured.unwrap import unwrap_by_code, unwrap_jointly, unwrap_range
from service.depth.patterns.readings import EvenLight, Readings, even_light
from stage.model import Resolution, Rgb
from stage.patterns.base import Axis
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Code, Collected
from stage.patterns.kary import KaryCode
from stage.patterns.modulated import ModulatedCode
from stage.patterns.phase import FULL_STEPS, PhaseCode
from stage.patterns.ramp import RampCode

CHANGED_RAD = 8**0.5
"""RMS error of a phase over the part of white by which the mean of its wave has moved: one of N frames that is brighter by x moves the mean
by x/N, and the phase by 4x/N sin φ."""


class PatternProjector(NamedTuple):
    """The properties of a projector that decoding needs; its lens and pose are needed by triangulation alone."""

    resolution: Resolution
    response: tuple[float, ...] | None = None
    crosstalk: tuple[Rgb, Rgb, Rgb] | None = None
    exponent: float = 1.0
    """The exponent γ of light = level^γ that the waves show, or of light = response^γ where one is given: their error is added to the
    deviation."""
    left_rad: float | None = None
    """The error of a phase that is left when waves are bent back by the exponent; None: they are not bent back."""
    changed: float = 0.0
    """The part of white by which light that has changed between the frames moves the mean of waves: its error is added to the deviation."""
    edge_error_px: float = EDGE_ERROR
    """The error in camera pixels of an edge of stripes, as of `measured_edge_error`."""
    unseen_digits: tuple[tuple[str, Axis, int], ...] = ()
    """Codes of k-ary digits or plain bits and their axes, and the number of the finest that the camera does not resolve."""

    def extent(self, axis: Axis) -> int:
        """Return the projector's pixels along an axis."""
        return self.resolution[0 if axis == "column" else 1]

    def unseen(self, code: BinaryCode | KaryCode) -> int:
        """Return the number of unseen digits of a code."""
        return sum(count for name, axis, count in self.unseen_digits if (name, axis) == (code.name, code.axis))

    def levels_of(self, code: KaryCode) -> np.ndarray:
        """Return the readings of the values of a digit as parts of white minus black, [k, channels], one channel for grey levels."""
        crosstalk = None if self.crosstalk is None or code.colors is None else np.array(self.crosstalk)
        return expected_levels(light_of(self.response, np.array(code.levels if code.levels is not None else code.colors)), crosstalk)

    @property
    def wave_response(self) -> Sequence[float] | None:
        """Return the response by which waves are bent back, declared or found; None: none."""
        return self.response if self.left_rad is None else tuple(self.shown_light(self.exponent).tolist())

    def shown_light(self, exponent: float) -> np.ndarray:
        """Return the light at 256 even levels from 0 to 1 where it is the declared light to the power of an exponent, [256]."""
        return np.asarray(light_of(self.response, np.linspace(0, 1, 256))**exponent)

    def wave_error(self, shifts: Sequence[float], period_px: float) -> float:
        """Return the RMS error in radians of a phase that is fitted to waves of the exponent, or in changed light, as if to others."""
        if self.exponent == 1.0:
            return CHANGED_RAD * self.changed
        if self.left_rad is not None:
            return self.left_rad
        own = np.array(shifts)
        return wave_error(self.shown_light(self.exponent), weights(own, period_px), own, self.response)


@dataclass(frozen=True)
class AxisDecoder:
    """The decoder of one axis."""

    axis: Axis
    name: str
    """The name for the report: gray with inverses, phase numbered by gray, …"""
    colour: bool
    """True if it needs colour frames."""
    decode: Callable[[Readings, NoiseModel], Decoded]
    used: tuple[Code, ...]
    """The codes that it reads."""
    halo: int = 0
    """Number of rows above and below a band that decoding reads too."""
    made: EvenLight | None = None
    """The rule that makes white and black of phases, where it needs them and the capture has none."""

    def wide(self, extent: int) -> bool:
        """Return whether it reads a ramp, or waves of half the extent of the projector and more, alone."""
        return all(isinstance(code, RampCode) or (isinstance(code, PhaseCode) and min(code.periods_px) >= extent / 2) for code in self.used)


@dataclass(frozen=True)
class AxisCodes:
    """The codes of one axis whose frames are all there, and what their decoders need to know."""

    axis: Axis
    codes: tuple[Code, ...]
    white: int | None
    black: int | None
    projector: PatternProjector
    refine: bool
    """Interpolate a Gray code with inverses between the edges of its stripes."""
    made: EvenLight | None = None
    """The rule that makes white and black of phases; None where the capture has both, or no phases."""

    @classmethod
    def of(cls, collected: Collected, axis: Axis, projector: PatternProjector, *, refine: bool) -> "AxisCodes":
        """Return the codes of the axis that lack no frame; bits without references count if phases tell white and black."""
        own = [code for code in collected.codes if code.axis == axis]
        lacking = [code for code in own if code.lacks(collected.white, collected.black) is not None]
        made = even_light(collected, projector.response) if any(isinstance(code, BinaryCode) for code in lacking) else None
        ready = tuple(code for code in own if code not in lacking or (isinstance(code, BinaryCode) and made is not None))
        return cls(axis, ready, collected.white, collected.black, projector, refine, made)

    def made_for(self, code: Code) -> EvenLight | None:
        """Return how white and black are made for a code; None if it does without."""
        return self.made if code.lacks(self.white, self.black) is not None else None

    @property
    def extent(self) -> int:
        """Return the projector's pixels along the axis."""
        return self.projector.extent(self.axis)

    @property
    def stripes(self) -> list[BinaryCode | KaryCode]:
        """Return the codes that number stripes."""
        return [code for code in self.codes if isinstance(code, BinaryCode | KaryCode)]

    def numbering(self, periods_px: Sequence[float]) -> BinaryCode | KaryCode | None:
        """Return a code whose stripes are fine enough to number the periods of phases; None without one.

        Stripes of half a period number it by themselves. Those of a Gray code may be up to a period wide, as most scanners have them: its
        edges are refined by its inverses, and without inverses a quarter of the pixels stays undecided.
        """
        fine = next((code for code in self.stripes if 2 * code.stripe_px <= min(periods_px)), None)
        return fine or next((code for code in self.stripes if isinstance(code, BinaryCode) and code.name == "gray"
                             and code.stripe_px <= min(periods_px)), None)

    @property
    def phase(self) -> PhaseCode | None:
        """Return the phases of the axis."""
        return next((code for code in self.codes if isinstance(code, PhaseCode)), None)


def modulated_decoder(axis: AxisCodes) -> AxisDecoder | None:
    """Decode modulated phases, which hold direct light alone."""
    waves = [code for code in axis.codes if isinstance(code, ModulatedCode)]
    if not waves:
        return None
    periods = tuple(wave.period_px for wave in waves)
    plain = axis.phase if unwrap_range(periods, axis.extent) < axis.extent else None  # plain phases number periods that repeat
    if plain is not None and (plain.micro or axis.numbering(periods) is not None):
        plain = None

    def wrapped(readings: Readings, noise: NoiseModel) -> WrappedPhase:
        parts = [decode_modulated(readings.grey, wave.frames, period_px=wave.period_px, offset_rad=wave.offset_rad,
                                  response=axis.projector.response, noise=noise)
                 for wave in waves]
        if plain is not None:
            parts.append(_wrapped_phase(plain, axis, readings, noise))
        return parts[0] if len(parts) == 1 else join_periods(parts)

    if plain is None:
        return _unwrapped("modulated phase", axis, waves, periods, wrapped)
    return _unwrapped("modulated phase with phase", axis, [*waves, plain], (*periods, *dict.fromkeys(plain.periods_px)), wrapped)


def micro_decoder(axis: AxisCodes) -> AxisDecoder | None:
    """Decode micro phase shifting."""
    phase = axis.phase
    if phase is None or not phase.micro:
        return None

    period = next(period for period in phase.periods_px if phase.periods_px.count(period) >= FULL_STEPS)
    error = axis.projector.wave_error([s for s, p in zip(phase.shifts, phase.periods_px, strict=True) if p == period], period)

    def decode(readings: Readings, noise: NoiseModel) -> Decoded:
        return decode_micro(readings.grey, phase.frames, phase.periods_px, phase.shifts, black=axis.black, extent=axis.extent,
                            response=axis.projector.response, wave_error_px=error * period / (2 * np.pi), noise=noise)

    return AxisDecoder(axis.axis, "micro phase", False, decode, (phase,))


def phase_decoder(axis: AxisCodes) -> AxisDecoder | None:
    """Decode phases of one or several periods."""
    phase = axis.phase
    if phase is None:
        return None
    return _unwrapped("phase", axis, [phase], phase.periods_px,
                      lambda readings, noise: _wrapped_phase(phase, axis, readings, noise))


def stripe_decoder(axis: AxisCodes) -> AxisDecoder | None:
    """Decode the code whose stripes are finest, binary ones before digits."""
    code = min(axis.stripes, key=lambda code: (isinstance(code, KaryCode), code.stripe_px), default=None)
    if code is None:
        return None
    inverses = code.inverses if isinstance(code, BinaryCode) else None
    edges = axis.refine and inverses is not None and code.name == "gray"
    confirmed = inverses is not None and len(inverses) >= FINE_BITS
    halo = (REACH if edges and axis.axis == "row" else 0) + (AROUND if confirmed else 0)

    def decode(readings: Readings, noise: NoiseModel) -> Decoded:
        found = _decode_stripes(code, axis, readings, noise)
        if edges and inverses is not None:
            found = refine_edges(found, readings.alike, code.frames, inverses, columns=readings.columns, down=axis.axis == "row",
                                 extent=axis.extent, stripe_px=code.stripe_px, noise=noise, edge_error=axis.projector.edge_error_px)
        if confirmed and inverses is not None:
            found = confirm_stripes(found, readings.alike, code.frames, inverses, columns=readings.columns, stripe_px=code.stripe_px,
                                    noise=noise)
        return found

    made = axis.made_for(code)
    name = (f"{code.name}{' with inverses' if inverses else ''}{', edges refined' if edges else ''}"
            f"{', white and black from phases' if made else ''}")
    return AxisDecoder(axis.axis, name, _coloured(code), decode, (code,), halo=halo, made=made)


def ramp_decoder(axis: AxisCodes) -> AxisDecoder | None:
    """Decode the intensity ratio."""
    code = next((code for code in axis.codes if isinstance(code, RampCode)), None)
    if code is None:
        return None
    response = None if axis.projector.response is None else np.array(axis.projector.response)

    def decode(readings: Readings, noise: NoiseModel) -> Decoded:
        return decode_ramp(readings.grey, up=code.up, down=code.down, white=axis.white, black=axis.black, extent=axis.extent,
                           response=response, noise=noise)

    return AxisDecoder(axis.axis, "ramp", False, decode, (code,))


def _wrapped_phase(phase: PhaseCode, axis: AxisCodes, readings: Readings, noise: NoiseModel) -> WrappedPhase:
    errors = [axis.projector.wave_error(wave.shifts, wave.period_px) for wave in phase.waves]
    return decode_phase(readings.grey, phase.frames, phase.periods_px, phase.shifts, black=axis.black,
                        response=axis.projector.wave_response, wave_errors=errors, noise=noise)


def _unwrapped(name: str, axis: AxisCodes, waves: Sequence[PhaseCode | ModulatedCode], periods_px: Sequence[float],
               wrapped: Callable[[Readings, NoiseModel], WrappedPhase]) -> AxisDecoder:
    """Unwrap phases by a code whose stripes are fine enough to number the periods, else jointly."""
    numbering = axis.numbering(periods_px)
    if numbering is None:
        return AxisDecoder(axis.axis, name, False, lambda readings, noise: unwrap_jointly(wrapped(readings, noise), extent=axis.extent),
                           tuple(waves))

    inverses = numbering.inverses if isinstance(numbering, BinaryCode) and 2 * numbering.stripe_px > min(periods_px) else None

    def decode(readings: Readings, noise: NoiseModel) -> Decoded:
        stripes = _decode_stripes(numbering, axis, readings, noise)
        if inverses is not None:
            stripes = refine_edges(stripes, readings.alike, numbering.frames, inverses, columns=readings.columns, down=axis.axis == "row",
                                   extent=axis.extent, stripe_px=numbering.stripe_px, noise=noise,
                                   edge_error=axis.projector.edge_error_px)
        return unwrap_by_code(wrapped(readings, noise), stripes, stripe_px=numbering.stripe_px, extent=axis.extent)

    return AxisDecoder(axis.axis, f"{name} numbered by {numbering.name}{', edges refined' if inverses else ''}", _coloured(numbering),
                       decode, (*waves, numbering), made=axis.made_for(numbering),
                       halo=REACH if inverses is not None and axis.axis == "row" else 0)


def _decode_stripes(code: BinaryCode | KaryCode, axis: AxisCodes, readings: Readings, noise: NoiseModel) -> Decoded:
    if isinstance(code, KaryCode):
        assert axis.white is not None and axis.black is not None  # else it would not be among the codes
        frames = readings.colour if code.colors is not None and readings.colour is not None else readings.grey
        return decode_kary(frames, code.frames, white=axis.white, black=axis.black,
                           levels=axis.projector.levels_of(code), reflected=code.reflected, extent=axis.extent, stripe_px=code.stripe_px,
                           noise=noise)
    white, black = axis.white, axis.black
    if axis.made_for(code) is not None:
        assert readings.made is not None  # as the decoder has asked
        white, black = readings.made
    if code.name == "xor":
        return decode_xor(readings.grey, code.frames, code.inverses, base_bit=code.base_bit, white=white, black=black,
                          extent=axis.extent, stripe_px=code.stripe_px, noise=noise)
    run = decode_gray if code.name == "gray" else decode_binary
    return run(readings.grey, code.frames, code.inverses, white=white, black=black, extent=axis.extent,
               stripe_px=code.stripe_px, noise=noise)


def _coloured(code: BinaryCode | KaryCode) -> bool:
    return isinstance(code, KaryCode) and code.colors is not None
