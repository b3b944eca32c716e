"""What `relit depth` takes."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from service.requests.base import Options, Request, split_commas

Above0 = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _filters(given: Any) -> Any:
    return tuple(name for name in split_commas(given) if name) if isinstance(given, str) else split_commas(given)


class Ranging(StrEnum):
    """What a depth is measured with."""

    PATTERN = "pattern"
    """A projector's patterns: structured light."""
    LASER = "laser"
    """Spots and stripes of a laser."""
    TOF = "tof"
    """The time that light takes."""


class TofFilter(StrEnum):
    """Filters, each asked for by name; flying pixels are taken out before anything is smoothed."""

    FLYING = "flying"
    """Takes out pixels that lie between two surfaces; changes no other."""
    BILATERAL = "bilateral"
    """Smooths the range within edges of the amplitude; fills nothing in."""


class WhichReturn(StrEnum):
    """Which of several returns is the depth."""

    STRONGEST = "strongest"
    FIRST = "first"
    LAST = "last"


class TofChoices(BaseModel):
    """How time of flight is solved."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    filters: Annotated[tuple[TofFilter, ...], BeforeValidator(_filters)] = ()
    """As text, names with commas between."""
    vote: bool = True
    """Let neighbours decide between wraps that a pixel leaves open (continuous wave)."""
    which: WhichReturn = WhichReturn.STRONGEST
    """Of several returns (pulsed)."""
    temperature_c: float | None = Field(default=None, allow_inf_nan=False)
    """Of the camera, for a calibration with a temperature drift."""


class TofOptions(TofChoices):
    """The same, with the camera's calibration."""

    calibration: Path | None = None
    """A relit.tof/1 file; None: noise and pulse are estimated from the capture, nothing is corrected."""


class DepthOptions(Options):
    """How depth is decoded and which of it is kept."""

    using: Ranging | None = None
    """Which frames, where a capture holds several kinds; None: those that there are."""
    near_m: Above0 | None = None
    """Depths below are out of range."""
    far_m: Above0 | None = None
    """Depths above are out of range."""
    max_residual_px: Above0 = 4.0
    """Where column and row are decoded: how far, in projector pixels, they may lie from a place that the line of sight passes."""
    refine: bool = True
    """Interpolate a Gray code with inverses between the edges of its stripes."""
    read_noise: Above0 = 0.003
    """Standard deviation of a reading in the dark, quantisation included, as a part of full scale; patterns only."""
    photon_gain: NotNegative = 1e-4
    """Photon noise: full scale over the electrons that fill it; patterns only."""
    tof: TofChoices = TofChoices()
    """Of time of flight; `near_m` and `far_m` are ranges along the ray there."""
    normals: bool = False
    """Write nx ny nz into points.ply too."""


class DepthRequest(DepthOptions, Request):
    """Depth of a capture from projected patterns, a laser, or time of flight."""

    capture: Path
    out: Path
    """Folder for depth.exr, points.ply and report.json."""
    tof: TofOptions = TofOptions()
    """Of time of flight, with the camera's calibration; `near_m` and `far_m` are ranges along the ray there."""
