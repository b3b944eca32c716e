"""Which decoder an axis of a capture's patterns takes, and how it is called."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kernels.structured.binary import decode_binary, decode_gray, decode_xor
from kernels.structured.decoded import Decoded
from kernels.structured.edges import REACH, refine_edges
from kernels.structured.frames import Frames, NoiseModel
from kernels.structured.join import join_periods
from kernels.structured.kary import decode_kary
from kernels.structured.micro import decode_micro
from kernels.structured.modulated import decode_modulated
from kernels.structured.phase import WrappedPhase, decode_phase
from kernels.structured.ramp import decode_ramp
from kernels.structured.unwrap import unwrap_by_code, unwrap_jointly
from stage.errors import ManifestError
from stage.model import Resolution, Rgb
from stage.patterns.collect import BinaryCode, Code, Collected, KaryCode, ModulatedCode, PhaseCode, RampCode

FULL_STEPS = 3
"""Frames of different shifts that a phase of its own needs."""


class PatternDevice(NamedTuple):
    """What decoding needs to know of a projector; its lens and pose come later."""

    resolution: Resolution
    response: tuple[float, ...] | None = None
    crosstalk: tuple[Rgb, Rgb, Rgb] | None = None


class Readings(NamedTuple):
    """The frames of a band on the device."""

    grey: Frames
    colour: Frames | None
    """The same with three channels, where a code has colours."""
    columns: int
    """Pixels of an image row: the band is whole rows."""


@dataclass(frozen=True)
class AxisPlan:
    """How one axis is decoded."""

    axis: str
    name: str
    """For the report: gray with inverses, phase numbered by gray, …"""
    colour: bool
    """Whether it needs colour frames."""
    decode: Callable[[Readings, NoiseModel], Decoded]
    halo: int = 0
    """Rows beyond a band, above and below, that decoding looks at."""
    unused: tuple[str, ...] = ()
    """Codes of the axis that add nothing to this plan."""


def plan_axis(collected: Collected, axis: str, projector: PatternDevice, *, refine: bool = False) -> AxisPlan | None:
    """The most precise way to decode an axis from the codes that there are: phases, else stripes, else digits, else a ramp.

    Args:
        collected: the codes of a capture.
        axis: column or row.
        projector: its resolution, response and crosstalk.
        refine: interpolate a Gray code with inverses between the edges of its stripes.

    Returns:
        None where the axis has no code.

    Raises:
        ManifestError: a code lacks the frames of black and white that it needs, or relit has no decoder for it.
    """
    codes = [code for code in collected.codes if code.axis == axis]
    if not codes:
        return None
    extent = projector.resolution[0 if axis == "column" else 1]
    ready = [code for code in codes if _complete(code, collected)]
    stripes = [code for code in ready if isinstance(code, BinaryCode | KaryCode)]
    modulated = [code for code in ready if isinstance(code, ModulatedCode)]
    phase = next((code for code in ready if isinstance(code, PhaseCode)), None)
    if modulated:  # direct light alone: better than the same phase without a carrier
        numbering = _numbering(stripes, [code.period_px for code in modulated])
        return _wave_plan(modulated, "modulated phase", numbering, collected, codes, projector, extent)
    if phase is not None and _is_micro(phase):
        return _micro_plan(phase, collected, codes, extent)
    if phase is not None:
        return _wave_plan([phase], "phase", _numbering(stripes, phase.periods_px), collected, codes, projector, extent)
    if stripes:
        return _stripe_plan(min(stripes, key=lambda code: (isinstance(code, KaryCode), code.stripe_px)), collected, codes, projector,
                            extent, refine)
    for code in ready:
        if isinstance(code, RampCode):
            return _ramp_plan(code, collected, codes, projector, extent)
    raise ManifestError(_lacks(codes[0]))


def _complete(code: Code, collected: Collected) -> bool:
    """Whether a code has the reference frames that it needs."""
    references = collected.white is not None and collected.black is not None
    match code:
        case PhaseCode() | ModulatedCode():
            return True
        case BinaryCode():
            return code.inverses is not None or references
        case KaryCode():
            return references
        case RampCode():
            return (code.up is not None and code.down is not None) or collected.white is not None


def _lacks(code: Code) -> str:
    match code:
        case BinaryCode():
            return f"the {code.axis} {code.code} code has neither inverses nor a white and a black frame: give one of the two"
        case KaryCode():
            return f"the {code.axis} kary code needs a white and a black frame: give both"
    return f"the {code.axis} ramp needs its opposite or a white frame: give one"


def _numbering(stripes: list[BinaryCode | KaryCode], periods_px: Sequence[float]) -> BinaryCode | KaryCode | None:
    """A code whose stripes are fine enough to number the periods."""
    return next((code for code in stripes if 2 * code.stripe_px <= min(periods_px)), None)


def _is_micro(phase: PhaseCode) -> bool:
    """Whether one period has all its steps and others have fewer than a phase of their own needs (Gupta and Nayar 2012)."""
    counts = [phase.periods_px.count(period) for period in dict.fromkeys(phase.periods_px)]
    return min(counts) < FULL_STEPS <= max(counts)


def _micro_plan(phase: PhaseCode, collected: Collected, codes: list[Code], extent: int) -> AxisPlan:
    def decode(readings: Readings, noise: NoiseModel) -> Decoded:
        return decode_micro(readings.grey, phase.frames, phase.periods_px, phase.shifts, black=collected.black, extent=extent, noise=noise)

    return AxisPlan(phase.axis, "micro phase", False, decode, unused=_unused(codes, [phase]))


def _wave_plan(waves: Sequence[PhaseCode | ModulatedCode], name: str, numbering: BinaryCode | KaryCode | None, collected: Collected,
               codes: list[Code], projector: PatternDevice, extent: int) -> AxisPlan:
    def wrapped(readings: Readings, noise: NoiseModel) -> WrappedPhase:
        parts = [decode_modulated(readings.grey, wave.frames, period_px=wave.period_px, noise=noise) if isinstance(wave, ModulatedCode)
                 else decode_phase(readings.grey, wave.frames, wave.periods_px, wave.shifts, black=collected.black, noise=noise)
                 for wave in waves]
        return parts[0] if len(parts) == 1 else join_periods(parts)

    def decode(readings: Readings, noise: NoiseModel) -> Decoded:
        phases = wrapped(readings, noise)
        if numbering is None:
            return unwrap_jointly(phases, extent=extent)
        coarse = _decode_stripes(numbering, collected, projector, extent, readings, noise)
        return unwrap_by_code(phases, coarse, stripe_px=numbering.stripe_px, extent=extent)

    used: list[Code] = [*waves, *([] if numbering is None else [numbering])]
    name = name if numbering is None else f"{name} numbered by {_name(numbering)}"
    return AxisPlan(waves[0].axis, name, _coloured(numbering), decode, unused=_unused(codes, used))


def _stripe_plan(code: BinaryCode | KaryCode, collected: Collected, codes: list[Code], projector: PatternDevice, extent: int,
                 refine: bool) -> AxisPlan:
    inverses = code.inverses if isinstance(code, BinaryCode) else None
    edges = refine and inverses is not None and isinstance(code, BinaryCode) and code.code == "gray"

    def decode(readings: Readings, noise: NoiseModel) -> Decoded:
        found = _decode_stripes(code, collected, projector, extent, readings, noise)
        if not edges or inverses is None:
            return found
        return refine_edges(found, readings.grey, code.frames, inverses, columns=readings.columns, down=code.axis == "row",
                            extent=extent, stripe_px=code.stripe_px, noise=noise)

    name = f"{_name(code)}{' with inverses' if inverses else ''}{', edges refined' if edges else ''}"
    return AxisPlan(code.axis, name, _coloured(code), decode, REACH if edges and code.axis == "row" else 0, _unused(codes, [code]))


def _ramp_plan(code: RampCode, collected: Collected, codes: list[Code], projector: PatternDevice, extent: int) -> AxisPlan:
    response = None if projector.response is None else np.array(projector.response)

    def decode(readings: Readings, noise: NoiseModel) -> Decoded:
        return decode_ramp(readings.grey, up=code.up, down=code.down, white=collected.white, black=collected.black, extent=extent,
                           response=response, noise=noise)

    return AxisPlan(code.axis, "ramp", False, decode, unused=_unused(codes, [code]))


def _decode_stripes(code: BinaryCode | KaryCode, collected: Collected, projector: PatternDevice, extent: int, readings: Readings,
                    noise: NoiseModel) -> Decoded:
    if isinstance(code, KaryCode):
        assert collected.white is not None and collected.black is not None  # the plan saw to it
        crosstalk = None if projector.crosstalk is None or code.colors is None else np.array(projector.crosstalk)
        frames = readings.colour if code.colors is not None and readings.colour is not None else readings.grey
        return decode_kary(frames, code.frames, white=collected.white, black=collected.black,
                           levels=np.array(code.levels if code.levels is not None else code.colors), reflected=code.reflected,
                           extent=extent, stripe_px=code.stripe_px, crosstalk=crosstalk, noise=noise)
    if code.code == "xor":
        return decode_xor(readings.grey, code.frames, code.inverses, base_bit=code.base_bit, white=collected.white,
                          black=collected.black, extent=extent, stripe_px=code.stripe_px, noise=noise)
    run = decode_gray if code.code == "gray" else decode_binary
    return run(readings.grey, code.frames, code.inverses, white=collected.white, black=collected.black, extent=extent,
               stripe_px=code.stripe_px, noise=noise)


def _coloured(code: BinaryCode | KaryCode | None) -> bool:
    return isinstance(code, KaryCode) and code.colors is not None


def _name(code: Code) -> str:
    return code.code if isinstance(code, BinaryCode) else type(code).__name__.removesuffix("Code").lower()


def _unused(codes: list[Code], used: list[Code]) -> tuple[str, ...]:
    return tuple(f"{code.axis} {_name(code)}" for code in codes if code not in used)
