"""The options of `relit import interleaved`."""

from pathlib import Path
from typing import Annotated

from service.requests.base.base import Role, Spelling, WidthHeight
from service.requests.imports.base import EncodingOptions, ImportRequest
from service.requests.patterns import Side
from stage.model import Line, Positive


class InterleavedImport(EncodingOptions, ImportRequest):
    """Frames of a moving subject under lights that repeat a plan, a folder of images or a video, as a sequence: a capture each period."""

    period: Annotated[Line, Role.INPUT, Spelling(metavar="PLAN")]
    """The frames of one period: a plan.json (relit.plan/1), or names with commas between, such as dark,olat. A tracking frame that begins
    a period closes the one before."""
    rig: Annotated[Path | None, Role.INPUT, Spelling(metavar="RIG.json")] = None
    """The lamps (relit.rig/1), and the camera if the file has one; None: a projector alone gives light."""
    projector: Annotated[tuple[Side, Side] | None, WidthHeight, Spelling(metavar="WxH")] = None
    """Width and height of the projector in pixels, for patterns."""
    images: Annotated[Line | None, Spelling(metavar="GLOB")] = None
    """Names of the frames, such as 'take3_*.exr', taken in natural order; None: every image but the mask."""
    mask: Annotated[Line | None, Spelling(metavar="NAME")] = None
    """Image of the mask of all steps; None: the one with the word mask in its name, if there is one."""
    frames: Annotated[Line | None, Spelling(metavar="FIRST-LAST[:STEP]")] = None
    """Frames that are used, counted from 0, such as 12-600; None: all."""
    frame_rate: Positive | None = None
    """Frames of the camera a second; None: as a video says, else 24 periods a second."""
    saturation: Positive | None = None
    """The recorded value from which readings are clipped; None: full scale."""
