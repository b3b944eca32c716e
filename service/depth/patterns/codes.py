"""The table of structured-light codes: what `relit patterns` projects for each, what it costs, and which decoder reads it.

To add a code:

1. stage/patterns/NEW.py: `NewPattern` (the manifest entry of a frame, with its level at each place), `NewCode` (the frames of a capture
   that make up the code) and `new_patterns` (the frames to project). In stage/patterns/codes.py: a row of `CODES`, and a member of the
   unions `Pattern` and `Code`.
2. stage/patterns/planner.py: a function that gives the standard deviation of the code.
3. kernels/structured/NEW.py: the kernel that decodes it.
4. service/depth/patterns/decoders.py: `new_decoder`. A code that numbers stripes has no decoder of its own: it goes into
   `AxisCodes.stripes` and `_decode_stripes`, so that it numbers the periods of phases too.
5. service/requests/patterns.py: a `PatternCode`, which is what users type, and the options that belong to the code.
6. Here: a row of `CODES`. Its place is its precedence: if a capture holds several codes, the decoder of the first is used.
7. docs/structured_light.md and docs/capture.md; tests in tests/stage/patterns, tests/kernels/structured and tests/service/depth, with a
   float64 twin in tests/reference/structured.py.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from kernels.structured.unwrap import unwrap_range
from service.depth.patterns.decoders import (
    AxisCodes,
    AxisDecoder,
    PatternProjector,
    micro_decoder,
    modulated_decoder,
    phase_decoder,
    ramp_decoder,
    stripe_decoder,
)
from service.requests.patterns import PatternCode, PatternsRequest, PlanRequest
from stage.errors import ManifestError
from stage.patterns import planner
from stage.patterns.base import Axis, digit_count
from stage.patterns.binary import binary_patterns, xor_patterns
from stage.patterns.codes import Collected, Pattern
from stage.patterns.kary import kary_patterns, palette
from stage.patterns.modulated import modulated_patterns
from stage.patterns.phase import joint_periods, micro_patterns, phase_patterns
from stage.patterns.planner import Cost
from stage.patterns.ramp import ramp_patterns


class CodeRow(NamedTuple):
    """The properties of one code that the commands need."""

    decoder: Callable[[AxisCodes], AxisDecoder | None]
    """Returns the decoder of an axis's frames, or None if they hold no such code."""
    patterns: Callable[[PatternsRequest, Axis, int], Sequence[Pattern]]
    """Returns the frames to project along an axis whose extent in pixels is given; raises ValueError if an option cannot be used."""
    options: tuple[str, ...]
    """The options of `relit patterns` that belong to the code."""
    cost: Callable[[PlanRequest, int], Cost] | None
    """Returns the line of the planner's table for a given number of columns; None if the line of another code stands for this one too."""


def _phase_frames(request: PatternsRequest, axis: Axis, extent: int) -> Sequence[Pattern]:
    periods = request.periods or joint_periods(extent)
    frames = phase_patterns(axis, periods, request.steps)
    covered = unwrap_range(periods, extent)
    if covered < extent:
        raise ValueError(f"phases of {', '.join(f'{period:g}' for period in periods)} px repeat after {covered:.4g} px, the "
                         f"projector has {extent}: add a period, or project gray-phase")
    return frames


def _gray_phase_frames(request: PatternsRequest, axis: Axis, extent: int) -> Sequence[Pattern]:
    periods = request.periods or (16.0,)
    stripe = request.stripe or min(periods) / 2
    if 2 * stripe > min(periods):
        raise ValueError(f"stripes of {stripe:g} px number periods of {min(periods):g} px less surely than they might: "
                         "give half a period or less")
    return (*binary_patterns(extent, axis, stripe_px=stripe, inverses=request.inverses), *phase_patterns(axis, periods, request.steps))


def _binary_cost(name: str, columns: int) -> Cost:
    return Cost(name, planner.kary_count(columns), 2 * digit_count(columns, 2) + 2, planner.STRIPE_SIGMA)


def _periods(request: PlanRequest, columns: int) -> tuple[float, ...]:
    return request.periods or joint_periods(columns)


def _phase_cost(request: PlanRequest, columns: int) -> Cost:
    periods = _periods(request, columns)
    listed = ", ".join(f"{period:g}" for period in periods)
    return Cost(f"phase, {request.steps} steps of {listed} px", planner.PHASE_COUNT, request.steps * len(periods),
                planner.phase_sigma(periods, request.steps, request.noise))


def _micro_cost(request: PlanRequest, columns: int) -> Cost:
    periods, count = _periods(request, columns), request.micro_periods
    mean = sum(periods) / len(periods)
    return Cost(f"micro, {count} periods about {mean:g} px", count + 2, count + 2, planner.phase_sigma((mean,), count + 2, request.noise))


CODES: dict[PatternCode, CodeRow] = {
    PatternCode.MODULATED: CodeRow(
        modulated_decoder,
        lambda request, axis, extent: [
            pattern for period in request.periods or (round(1.1 * extent, 1),)
            for pattern in modulated_patterns(axis, period, steps=request.steps, carrier_period_px=request.carrier)],
        ("periods", "steps", "carrier"),
        lambda request, columns: Cost(f"modulated, {request.steps} steps over 3", 9, 3 * request.steps,
                                      planner.modulated_sigma(columns, request.steps, 3, request.noise))),
    PatternCode.MICRO: CodeRow(
        micro_decoder,
        lambda request, axis, extent: micro_patterns(extent, axis, periods=request.micro_periods, mean_period_px=request.mean_period),
        ("micro_periods", "mean_period"),
        _micro_cost),
    PatternCode.PHASE: CodeRow(phase_decoder, _phase_frames, ("periods", "steps"), _phase_cost),
    PatternCode.GRAY_PHASE: CodeRow(phase_decoder, _gray_phase_frames, ("stripe", "inverses", "periods", "steps"), None),
    PatternCode.BINARY: CodeRow(
        stripe_decoder,
        lambda request, axis, extent: binary_patterns(extent, axis, code="binary", stripe_px=request.stripe or 1,
                                                      inverses=request.inverses),
        ("stripe", "inverses"),
        lambda request, columns: _binary_cost("binary or gray, with inverses", columns)),
    PatternCode.GRAY: CodeRow(
        stripe_decoder,
        lambda request, axis, extent: binary_patterns(extent, axis, code="gray", stripe_px=request.stripe or 1, inverses=request.inverses),
        ("stripe", "inverses"),
        None),
    PatternCode.XOR: CodeRow(
        stripe_decoder,
        lambda request, axis, extent: xor_patterns(extent, axis, base_bit=request.base_bit, stripe_px=request.stripe or 1,
                                                   inverses=request.inverses),
        ("stripe", "inverses", "base_bit"),
        lambda request, columns: _binary_cost("xor, with inverses", columns)),
    PatternCode.KARY: CodeRow(
        stripe_decoder,
        lambda request, axis, extent: kary_patterns(extent, axis, base=request.base, reflected=request.reflected,
                                                    stripe_px=request.stripe or 1),
        ("stripe", "base", "reflected"),
        lambda request, columns: Cost(f"kary, base {request.base}", planner.kary_count(columns, request.base),
                                      digit_count(columns, request.base) + 2, planner.STRIPE_SIGMA)),
    PatternCode.COLOR: CodeRow(
        stripe_decoder,
        lambda request, axis, extent: kary_patterns(extent, axis, base=request.base, reflected=request.reflected,
                                                    stripe_px=request.stripe or 1, colors=palette(request.base)),
        ("stripe", "base", "reflected"),
        None),
    PatternCode.RAMP: CodeRow(
        ramp_decoder,
        lambda request, axis, extent: ramp_patterns(axis),
        (),
        lambda request, columns: Cost("ramp", planner.RATIO_COUNT, planner.RATIO_COUNT + 2, planner.ramp_sigma(columns, request.noise))),
}
"""Every code, the most precise first: `choose_decoder` tries their decoders in this order."""

CODES_OF_OPTION = {option: tuple(code for code in PatternCode if option in CODES[code].options)
                   for row in CODES.values() for option in row.options}
"""The codes that each option of `relit patterns` belongs to; with another code the option is refused."""


def choose_decoder(collected: Collected, axis: Axis, projector: PatternProjector, *,
                   refine: bool = False) -> tuple[AxisDecoder | None, tuple[str, ...]]:
    """Choose the most precise way to decode an axis from the codes of a capture: phases, else stripes, else digits, else a ramp.

    Args:
        refine: interpolate a Gray code with inverses between the edges of its stripes.

    Returns:
        The decoder, None if the axis has no code; and the names of the codes of the axis that it does not use.

    Raises:
        ManifestError: every code of the axis lacks the frames of black and white that it needs.
    """
    codes = [code for code in collected.codes if code.axis == axis]
    if not codes:
        return None, ()
    ready = AxisCodes.of(collected, axis, projector, refine=refine)
    for decoder in dict.fromkeys(row.decoder for row in CODES.values()):
        chosen = decoder(ready)
        if chosen is not None:
            return chosen, tuple(f"{axis} {code.name}" for code in codes if code not in chosen.used)
    raise ManifestError(codes[0].lacks(collected.white, collected.black))
