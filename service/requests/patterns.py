"""What `relit patterns` takes: the request for images to project, and that for the planner's table."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base import Choice, Commas, Options, Role, Spelling, WidthHeight
from stage.model import Positive

MAX_SIDE = 16384
"""Pixels of a projector's side; larger than any that is built."""

Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]


class PatternCode(Choice):
    """What to project."""

    BINARY = "binary", "binary numbers of stripes"
    GRAY = "gray", "Gray code, of which one image changes at an edge"
    XOR = "xor", "Gray code in narrow stripes, for surfaces that light each other"
    KARY = "kary", "base-k digits as grey levels"
    COLOR = "color", "base-k digits as colours"
    RAMP = "ramp", "intensity ratio"
    PHASE = "phase", "phase shifting"
    GRAY_PHASE = "gray-phase", "phase shifting of one period, numbered by Gray code"
    MICRO = "micro", "micro phase shifting"
    MODULATED = "modulated", "modulated phase shifting"


class PatternAxis(Choice):
    """Which projector coordinate is coded."""

    COLUMN = "column"
    ROW = "row"
    BOTH = "both"


class CodeOptions(Options):
    """What the images and the planner's table have in common."""

    projector: Annotated[tuple[Side, Side], WidthHeight, Spelling(metavar="WxH")]
    """Width and height of the projector in pixels; as text 1280x800."""
    axis: PatternAxis = PatternAxis.COLUMN
    """The projector coordinate to code; the table takes both for column."""
    base: int = Field(default=3, ge=2)
    """kary, color: base of the digits."""
    periods: Annotated[tuple[Positive, ...], Commas, Spelling(metavar="P,P,…")] | None = None
    """phase, gray-phase, modulated: periods in pixels; None: three that tell the projector's places apart; 16; 1.1 times its extent."""
    steps: int = Field(default=4, ge=3, le=64)
    """phase, gray-phase, modulated: images of each period."""
    micro_periods: int = Field(default=6, ge=3, le=32)
    """micro: number of periods."""


class PatternsRequest(CodeOptions):
    """Images to project and their manifest entries; each option belongs to the codes that its line names."""

    code: Annotated[PatternCode, Spelling(argument=True, metavar="CODE")]
    """What to project; not needed with --plan."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for the images and patterns.json."""
    bits: int = Field(default=8, ge=8, le=16, multiple_of=8)
    """Bits of a channel in the PNG files, 8 or 16."""
    gamma: Positive = 1.0
    """Gamma of the projector: a level of linear light is stored as level^(1/gamma)."""
    stripe: Positive | None = None
    """binary, gray, xor, kary, color, gray-phase: width of the finest stripe in pixels; None: 1, with gray-phase half a period."""
    inverses: bool = True
    """binary, gray, xor, gray-phase: project every image also inverted."""
    base_bit: int = Field(default=0, ge=0)
    """xor: 0 for XOR-02, 1 for XOR-04."""
    reflected: Annotated[bool, Spelling(off="--plain")] = True
    """kary, color: k-ary Gray code, in which neighbours differ in one digit by one."""
    mean_period: Positive = 24.0
    """micro: the period about which all lie, in pixels."""
    carrier: Positive = 8.0
    """modulated: period of the carrier, in pixels."""


class PlanRequest(CodeOptions):
    """The planner's table for one axis of a projector."""

    frame_rate: Annotated[Positive, Spelling(flag="--fps")] = 30.0
    """Plan: images a second."""
    noise: Positive = 0.02
    """Plan: standard deviation of a reading over the amplitude of the pattern."""
    baseline: Positive | None = None
    """Plan: projector to camera, in metres; with `distance` and `focal` the depth's precision is told."""
    distance: Positive | None = None
    """Plan: distance of the object, in metres."""
    focal: Positive | None = None
    """Plan: focal length of the projector, in pixels."""
