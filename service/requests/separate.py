"""What `relit separate` takes."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base import CAPTURE, PixelOptions, Request, Role
from stage.model import Positive


class SeparateOptions(PixelOptions):
    """Which frames are used, and how."""

    period_px: Positive | None = None
    """Period of the phase frames to use, in projector pixels; None: the shortest of the capture, which must not exceed 64."""
    black_level: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.0
    """Light of the projector's black as a fraction of its white, for a capture without a black frame."""


class SeparateRequest(SeparateOptions, Request):
    """Direct and global light of a capture under fine, shifted phase patterns."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for separation.exr and report.json."""
