"""What can be asked of the pattern generator, and of its planner."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

MAX_SIDE = 16384
"""Pixels of a projector's side; larger than any that is built."""


def _resolution(given: Any) -> Any:
    if not isinstance(given, str):
        return given
    sides = given.lower().replace("×", "x").split("x")
    if len(sides) != 2 or not all(side.strip().isdigit() for side in sides):
        raise ValueError(f"is {given}: give width x height in pixels, as in 1280x800")
    return tuple(int(side) for side in sides)


def _numbers(given: Any) -> Any:
    return tuple(part.strip() for part in given.split(",")) if isinstance(given, str) else given


Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class PatternCode(StrEnum):
    """What to project."""

    BINARY = "binary"
    """Binary numbers of stripes."""
    GRAY = "gray"
    """Gray code: one image changes at an edge."""
    XOR = "xor"
    """Gray code in narrow stripes, for surfaces that light each other."""
    KARY = "kary"
    """Base-k digits as grey levels."""
    COLOR = "color"
    """Base-k digits as colours."""
    RAMP = "ramp"
    """Intensity ratio."""
    PHASE = "phase"
    """Phase shifting."""
    GRAY_PHASE = "gray-phase"
    """Phase shifting of one period, numbered by Gray code."""
    MICRO = "micro"
    """Micro phase shifting."""
    MODULATED = "modulated"
    """Modulated phase shifting."""


class PatternAxis(StrEnum):
    """Which projector coordinate is coded."""

    COLUMN = "column"
    ROW = "row"
    BOTH = "both"


class PatternsRequest(BaseModel):
    """Images to project and their manifest entries; each option belongs to the codes that its line names."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    code: PatternCode
    projector: Annotated[tuple[Side, Side], BeforeValidator(_resolution)]
    """Width and height, pixels; as text 1280x800."""
    out: Path
    """Folder."""
    axis: PatternAxis = PatternAxis.COLUMN
    bits: int = Field(default=8, ge=8, le=16, multiple_of=8)
    """Of a channel in the files."""
    gamma: Positive = 1.0
    """Of the projector: a level of linear light is stored as level^(1/gamma)."""
    stripe: Positive | None = None
    """Finest stripe, pixels; binary, gray, xor, kary, color; None: 1, gray-phase: half a period."""
    inverses: bool = True
    """With inverses; binary, gray, xor, gray-phase."""
    base_bit: int = Field(default=0, ge=0)
    """xor: 0 for XOR-02, 1 for XOR-04."""
    base: int = Field(default=3, ge=2)
    """kary, color: k."""
    reflected: bool = True
    """kary, color: k-ary Gray code."""
    periods: Annotated[tuple[Positive, ...], BeforeValidator(_numbers)] | None = None
    """Pixels; phase, gray-phase, modulated; None: three that tell the projector's places apart; 16; 1.1 times its extent."""
    steps: int = Field(default=4, ge=3, le=64)
    """phase, gray-phase, modulated: of each period."""
    micro_periods: int = Field(default=6, ge=3, le=32)
    """micro: how many."""
    mean_period: Positive = 24.0
    """micro: about which they lie, pixels."""
    carrier: Positive = 8.0
    """modulated: period of the carrier, pixels."""


class PlanRequest(BaseModel):
    """The planner's table for one axis of a projector."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    projector: Annotated[tuple[Side, Side], BeforeValidator(_resolution)]
    axis: PatternAxis = PatternAxis.COLUMN
    """column or row; both: column."""
    frame_rate: Positive = 30.0
    """Images a second."""
    noise: Positive = 0.02
    """Standard deviation of a reading over the amplitude of the pattern."""
    baseline: Positive | None = None
    """Metres, projector to camera; with distance and focal the depth's precision is told."""
    distance: Positive | None = None
    """Metres."""
    focal: Positive | None = None
    """Of the projector, pixels."""
    base: int = Field(default=3, ge=2)
    periods: Annotated[tuple[Positive, ...], BeforeValidator(_numbers)] | None = None
    """Of phase, pixels; None: those that `relit patterns phase` projects."""
    steps: int = Field(default=4, ge=3, le=64)
    micro_periods: int = Field(default=6, ge=3, le=32)
