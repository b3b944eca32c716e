"""The options of `relit capture`."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator

from service.requests.base.base import Choice, Commas, DeviceRequest, Role, Spelling, WidthHeight
from service.requests.base.review import ReviewOptions
from service.requests.patterns import Side
from stage.colour.colour_spaces import ColorSpaceName
from stage.model import Count, FirstFault, Line, Positive, Strict


class Then(Choice):
    """What is made of a capture when its last picture is there."""

    SOLVE = "solve", "its maps, in the folder maps of the capture"
    EXPORT = "export", "of these an asset, asset.usdz in the capture"


class PlanChoices(Strict):
    """A plan as it is chosen without a file."""

    plan: Line
    """The names of its sequences, with commas between."""
    exposures_s: Annotated[tuple[Positive, ...], FirstFault] = ()
    """The exposure times of each picture of the capture itself; none: the one that the camera has."""
    tracking_every: Count | None = None
    """Number of pictures between tracking pictures; None: there are none."""
    lights: Annotated[tuple[Line, ...], Field(min_length=1), FirstFault] | None = None
    """The names of the lamps that are lit one by one; None: all lamps of the rig."""


class AcquireRequest(ReviewOptions, DeviceRequest):
    """Take a capture: switch each light or show each pattern, take the picture, check it, and write the capture folder as it goes. Given
    again, the command takes the pictures that are missing."""

    plan: Annotated[Line, Role.INPUT, Spelling(argument=True, metavar="PLAN")]
    """What is captured: a plan.json (relit.plan/1), or names with commas between, such as dark,olat: olat, gradients, polarised, dark,
    flat, chart, mirror-ball, grey-ball, projector-response, or a code of relit patterns."""
    camera: Annotated[Line, Spelling(metavar="CAMERA")]
    """The camera: watch:FOLDER or watch:FOLDER/*.jpg for the files that a tethering program writes, gphoto2 or gphoto2:PORT for a camera at
    a USB port, aravis or aravis:NAME for a machine-vision camera, video:0 for a video device."""
    out: Annotated[Path, Role.OUTPUT, Spelling(metavar="CAPTURE")]
    """The folder of the capture."""
    rig: Annotated[Path | None, Role.INPUT, Spelling(metavar="RIG.json")] = None
    """The lamps (relit.rig/1); None: a projector alone gives light."""
    trigger: Annotated[Line | None, Spelling(metavar="COMMAND")] = None
    """The program that releases a camera whose folder is watched, with its arguments; {exposure_s} stands for the exposure time. None: a
    person or another program releases it."""
    retakes: Annotated[int, Field(ge=0, le=20)] = 2
    """How often a picture with a fault is taken again."""
    preview: Annotated[bool, Role.RUN] = False
    """Take no capture, and meter the light: the share of the object that lamps clip, its focus, and a proposed exposure, in meter.json and
    meter.png."""
    live: Annotated[bool, Role.RUN] = True
    """With --preview on a terminal: show before it, on a page of this machine, the live view of a camera that has one, until Enter is
    pressed."""
    jpeg: bool = False
    """Let a camera at a USB port that offers raw files keep the format that it has, such as JPEG."""
    then: Annotated[tuple[Then, ...], FirstFault, Commas, Role.RUN, Spelling(metavar="STEPS")] = ()
    """What is made of the capture when its last picture is there: solve, or solve,export; not where a picture has a fault."""
    to: Annotated[Line | None, Role.RUN, Spelling(metavar="URL")] = None
    """The service to which pictures are sent as they are taken, and on which the capture is whole after the last; its key is that of the
    environment variable RELIT_KEY. None: none."""
    retake: Annotated[tuple[Line, ...], FirstFault, Role.RUN, Spelling(metavar="SHOT")] = ()
    """A picture that is taken again, though it is there, such as 0017_light_016. May be repeated."""
    timeout: Positive = 30.0
    """Seconds until a picture counts as missing, beside its exposure."""
    projector: Annotated[tuple[Side, Side] | None, WidthHeight, Spelling(metavar="WxH")] = None
    """Width and height of the projector in pixels, for patterns."""
    projector_port: Annotated[int, Field(ge=0, le=65535)] = 8572
    """The port, on this machine, of the page that shows patterns in a browser on the projector's screen; 0: any free one."""
    gamma: Positive = 1.0
    """Gamma of the projector: a level of linear light is shown as level^(1/gamma)."""
    color_space: ColorSpaceName | None = None
    """The colour space of the pictures; None: srgb_texture for integers of 8 bits, else scene-linear."""
    saturation: Positive | None = None
    """The recorded value from which readings are clipped, which the manifest has too; None: full scale."""

    @field_validator("then")
    @classmethod
    def _in_order(cls, then: tuple[Then, ...]) -> tuple[Then, ...]:
        if then != tuple(Then)[:len(then)]:
            raise ValueError("give solve, or solve,export")
        return then
