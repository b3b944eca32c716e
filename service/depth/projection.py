"""Images to project and their manifest entries, and the planner's table."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels.structured.unwrap import unwrap_range
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.patterns import PatternAxis, PatternCode, PatternsRequest, PlanRequest
from service.usd.textures import write_png
from stage.files import replacing, write_text
from stage.manifest import Frame
from stage.pattern import Axis, Pattern, UniformPattern
from stage.patterns import planner, stripes, waves
from stage.patterns.draw import draw

FRAGMENT = "patterns.json"
BELONGS: dict[str, tuple[PatternCode, ...]] = {
    "stripe": (PatternCode.BINARY, PatternCode.GRAY, PatternCode.XOR, PatternCode.KARY, PatternCode.COLOR, PatternCode.GRAY_PHASE),
    "inverses": (PatternCode.BINARY, PatternCode.GRAY, PatternCode.XOR, PatternCode.GRAY_PHASE),
    "base_bit": (PatternCode.XOR,),
    "base": (PatternCode.KARY, PatternCode.COLOR),
    "reflected": (PatternCode.KARY, PatternCode.COLOR),
    "periods": (PatternCode.PHASE, PatternCode.GRAY_PHASE, PatternCode.MODULATED),
    "steps": (PatternCode.PHASE, PatternCode.GRAY_PHASE, PatternCode.MODULATED),
    "micro_periods": (PatternCode.MICRO,),
    "mean_period": (PatternCode.MICRO,),
    "carrier": (PatternCode.MODULATED,),
}
"""Which codes an option says something about; with another one it is refused."""


class PatternsResult(NamedTuple):
    """What was written."""

    images: tuple[Path, ...]
    fragment: Path
    """patterns.json: the frames, as capture.json takes them."""


def make_patterns(request: PatternsRequest, progress: Progress | None = None) -> PatternsResult:
    """Write PNG images and patterns.json.

    Args:
        request: code, projector, options, folder.
        progress: told of every image.

    Raises:
        RequestError: an option that does not belong to the code, or that the code refuses.
        StorageError: a file cannot be written.
    """
    for name, codes in BELONGS.items():
        if name in request.model_fields_set and request.code not in codes:
            raise RequestError(f"{name} says nothing about {request.code}: it is an option of {', '.join(codes)}")
    timings = Timings(progress)
    try:
        patterns = patterns_of(request)
    except ValueError as error:
        raise RequestError(str(error)) from error
    images, frames = [], []
    timings.stage("draw", len(patterns))
    for index, pattern in enumerate(patterns):
        path = request.out / f"pattern_{index:03d}.png"
        with replacing(path) as temporary:
            write_png(temporary, stored(draw(pattern, request.projector), request.bits, request.gamma), srgb=False)
        images.append(path)
        frames.append(Frame(image=path.name, pattern=pattern).model_dump(mode="json", exclude_defaults=True))
        timings.advance(1)
    timings.close()
    fragment = request.out / FRAGMENT
    write_text(fragment, '{\n  "frames": [\n' + ",\n".join(f"    {json.dumps(frame)}" for frame in frames) + "\n  ]\n}\n")
    return PatternsResult(tuple(images), fragment)


def stored(levels: np.ndarray, bits: int, gamma: float) -> np.ndarray:
    """Levels of linear light, 0…1, as whole numbers for a projector of this gamma."""
    top = 2**bits - 1
    return np.floor(np.clip(levels, 0, 1).astype(np.float64) ** (1 / gamma) * top + 0.5).astype(np.uint8 if bits == 8 else np.uint16)


def patterns_of(request: PatternsRequest) -> tuple[Pattern, ...]:
    """The manifest entries of one request; white and black once, at the end.

    Raises:
        ValueError: the code refuses an option.
    """
    axes: dict[PatternAxis, tuple[Axis, ...]] = {PatternAxis.COLUMN: ("column",), PatternAxis.ROW: ("row",),
                                                 PatternAxis.BOTH: ("column", "row")}
    every = [pattern for axis in axes[request.axis] for pattern in _of_axis(request, axis, request.projector[0 if axis == "column" else 1])]
    coded = [pattern for pattern in every if not isinstance(pattern, UniformPattern)]
    return (*coded, *stripes.uniform_patterns())


def _of_axis(request: PatternsRequest, axis: Axis, extent: int) -> tuple[Pattern, ...]:
    stripe = request.stripe or 1.0
    match request.code:
        case PatternCode.BINARY:
            return stripes.binary_patterns(extent, axis, code="binary", stripe_px=stripe, inverses=request.inverses)
        case PatternCode.GRAY:
            return stripes.binary_patterns(extent, axis, code="gray", stripe_px=stripe, inverses=request.inverses)
        case PatternCode.XOR:
            return stripes.xor_patterns(extent, axis, base_bit=request.base_bit, stripe_px=stripe, inverses=request.inverses)
        case PatternCode.KARY:
            return stripes.kary_patterns(extent, axis, base=request.base, reflected=request.reflected, stripe_px=stripe)
        case PatternCode.COLOR:
            return stripes.kary_patterns(extent, axis, base=request.base, reflected=request.reflected, stripe_px=stripe,
                                         colors=stripes.palette(request.base))
        case PatternCode.RAMP:
            return waves.ramp_patterns(axis)
        case PatternCode.PHASE:
            periods = request.periods or waves.joint_periods(extent)
            frames = waves.phase_patterns(axis, periods, request.steps)
            covered = unwrap_range(periods, extent)
            if covered < extent:
                raise ValueError(f"phases of {', '.join(f'{period:g}' for period in periods)} px repeat after {covered:.4g} px, the "
                                 f"projector has {extent}: add a period, or project gray-phase")
            return frames
        case PatternCode.GRAY_PHASE:
            periods = request.periods or (16.0,)
            stripe = request.stripe or min(periods) / 2
            if 2 * stripe > min(periods):
                raise ValueError(f"stripes of {stripe:g} px cannot number periods of {min(periods):g} px: give half a period or less")
            return (*stripes.binary_patterns(extent, axis, stripe_px=stripe, inverses=request.inverses),
                    *waves.phase_patterns(axis, periods, request.steps))
        case PatternCode.MICRO:
            return waves.micro_patterns(extent, axis, periods=request.micro_periods, mean_period_px=request.mean_period)
        case PatternCode.MODULATED:
            return tuple(pattern for period in request.periods or (round(1.1 * extent, 1),)
                         for pattern in waves.modulated_patterns(axis, period, steps=request.steps, carrier_period_px=request.carrier))


def make_plan(request: PlanRequest) -> tuple[planner.Plan, ...]:
    """The planner's table.

    Raises:
        RequestError: baseline, distance and focal length are not given together, or the planner refuses a value.
    """
    rig = None
    if request.baseline is not None and request.distance is not None and request.focal is not None:
        rig = planner.Rig(request.baseline, request.distance, request.focal, request.noise)
    elif (request.baseline, request.distance, request.focal) != (None, None, None):
        raise RequestError("the depth's precision needs baseline, distance and focal together: give all three, or none")
    across = request.axis == PatternAxis.ROW
    columns, rows = request.projector[::-1] if across else request.projector
    try:
        return planner.plan(columns, rows, frame_rate=request.frame_rate, noise=request.noise, rig=rig, base=request.base,
                            periods_px=request.periods or waves.joint_periods(columns), steps=request.steps, micro=request.micro_periods)
    except ValueError as error:
        raise RequestError(str(error)) from error
