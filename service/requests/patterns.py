"""The options of `relit patterns`: the request for images to project, and that for the planner's table."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base.base import Choice, Commas, Options, Role, Spelling, WidthHeight
from stage.model import Positive

MAX_SIDE = 16384
"""Pixels of a projector's side; larger than any that is built."""

Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]


class PatternCode(Choice):
    """The code to project."""

    BINARY = "binary", "binary numbers of stripes"
    GRAY = "gray", "Gray code: at each edge of a stripe only one image changes"
    XOR = "xor", "Gray code whose stripes are all narrow, for surfaces that light each other"
    KARY = "kary", "base-k digits as grey levels"
    COLOR = "color", "base-k digits as colours"
    RAMP = "ramp", "a ramp of light and its opposite (intensity ratio)"
    PHASE = "phase", "phase shifting"
    GRAY_PHASE = "gray-phase", "phase shifting of one period, whose repetitions Gray code numbers"
    MICRO = "micro", "micro phase shifting: many short periods, for surfaces that light each other"
    MODULATED = "modulated", "modulated phase shifting: a fine carrier separates direct light"


class PatternAxis(Choice):
    """The projector coordinate that is coded."""

    COLUMN = "column"
    ROW = "row"
    BOTH = "both"


class CodeOptions(Options):
    """Options that the images and the planner's table share."""

    projector: Annotated[tuple[Side, Side], WidthHeight, Spelling(metavar="WxH")]
    """Width and height of the projector in pixels; as text 1280x800."""
    axis: PatternAxis = PatternAxis.COLUMN
    """The projector coordinate to code; --plan plans columns for both."""
    base: int = Field(default=3, ge=2)
    """kary, color: base of the digits."""
    periods: Annotated[tuple[Positive, ...], Commas, Spelling(metavar="P,P,…")] | None = None
    """phase, gray-phase, modulated: periods in pixels; None: for phase three that together tell all pixels of the projector apart, for
    gray-phase 16, for modulated 1.1 times the number of pixels."""
    steps: int = Field(default=4, ge=3, le=64)
    """phase, gray-phase, modulated: number of images for each period."""
    micro_periods: int = Field(default=6, ge=3, le=32)
    """micro: number of periods."""


class PatternsOptions(CodeOptions):
    """The images to draw; each option belongs to the codes that its line names."""

    code: Annotated[PatternCode, Spelling(argument=True, metavar="CODE")]
    """The code to project; not needed with --plan."""
    bits: int = Field(default=8, ge=8, le=16, multiple_of=8)
    """Bits of a channel in the PNG files, 8 or 16."""
    gamma: Positive = 1.0
    """Gamma of the projector: a level of linear light is stored as level^(1/gamma)."""
    stripe: Positive | None = None
    """binary, gray, xor, kary, color, gray-phase: width of the finest stripe in pixels; None: 1, for gray-phase half a period."""
    inverses: bool = True
    """binary, gray, xor, gray-phase: project every image also inverted."""
    base_bit: int = Field(default=0, ge=0)
    """xor: 0 for XOR-02, 1 for XOR-04."""
    reflected: Annotated[bool, Spelling(off="--plain")] = True
    """kary, color: k-ary Gray code, in which neighbours differ in one digit by one."""
    mean_period: Positive = 24.0
    """micro: mean of the periods, in pixels."""
    carrier: Positive = 8.0
    """modulated: period of the carrier, in pixels."""


class PatternsRequest(PatternsOptions):
    """Images to project and their manifest entries; each option belongs to the codes that its line names."""

    out: Annotated[Path, Role.OUTPUT]
    """Folder for the images and patterns.json."""


class PlanRequest(CodeOptions):
    """The planner's table for one axis of a projector."""

    frame_rate: Annotated[Positive, Spelling(flag="--fps")] = 30.0
    """--plan: images projected in a second."""
    noise: Positive = 0.02
    """--plan: standard deviation of a reading, as a fraction of the amplitude of the pattern."""
    baseline: Positive | None = None
    """--plan: distance between projector and camera in metres; with `distance` and `focal` the precision of the depth is printed too."""
    distance: Positive | None = None
    """--plan: distance of the object, in metres."""
    focal: Positive | None = None
    """--plan: focal length of the projector, in pixels."""
