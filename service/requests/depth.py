"""What `relit depth` takes."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator

from service.requests.base import Choice, Commas, Options, Request, Role, Spelling
from stage.model import Finite, NotNegative, Positive


def _without_blanks(given: Any) -> Any:
    return tuple(name for name in given if name) if isinstance(given, tuple) else given


class Ranging(Choice):
    """What a depth is measured with."""

    PATTERN = "pattern", "a projector's patterns, structured light"
    LASER = "laser", "spots and stripes of a laser"
    TOF = "tof", "the time that light takes"


class TofFilter(Choice):
    """Filters, each asked for by name; flying pixels are taken out before anything is smoothed."""

    FLYING = "flying", "takes out mixed pixels, which lie between two surfaces, and changes no other"
    BILATERAL = "bilateral", "smooths the range within edges of the amplitude, and fills nothing in"


class WhichReturn(Choice):
    """Which of several returns is the depth."""

    STRONGEST = "strongest"
    FIRST = "first"
    LAST = "last"


class TofChoices(Options):
    """How time of flight is solved."""

    filters: Annotated[tuple[TofFilter, ...], BeforeValidator(_without_blanks), Commas, Spelling(flag="--filter")] = ()
    """Filters of time of flight, as text with commas between."""
    vote: bool = True
    """Time of flight, continuous wave: let neighbours decide between wraps that a pixel leaves open."""
    which: Annotated[WhichReturn, Spelling(flag="--return")] = WhichReturn.STRONGEST
    """Time of flight, pulsed: the return that is the depth, of several."""
    temperature_c: Finite | None = None
    """Temperature of the camera, for a time-of-flight calibration with a temperature drift."""


class TofOptions(TofChoices):
    """How time of flight is solved, with the camera's calibration."""

    calibration: Annotated[Path | None, Role.INPUT, Spelling(flag="--tof-calibration")] = None
    """Noise, wiggling, offset, drift and pulse of a time-of-flight camera: a relit.tof/1 file; None: noise and pulse are estimated from
    the capture, nothing is corrected."""


class DepthOptions(Options):
    """How depth is decoded, and which depths are kept."""

    using: Ranging | None = None
    """Which frames, where a capture holds several kinds; None: those that there are."""
    near_m: Positive | None = None
    """Depths below, in metres, are out of range."""
    far_m: Positive | None = None
    """Depths above, in metres, are out of range."""
    max_residual_px: Positive = 4.0
    """Where column and row are decoded: how far, in projector pixels, they may lie from a place that the line of sight passes."""
    refine: bool = True
    """Interpolate a Gray code with inverses between the edges of its stripes."""
    read_noise: Positive = 0.003
    """Standard deviation of a reading in the dark, quantisation included, as a part of full scale; patterns only."""
    photon_gain: NotNegative = 1e-4
    """Photon noise: full scale over the electrons that fill a pixel; patterns only."""
    tof: TofChoices = TofChoices()
    """How time of flight is solved; `near_m` and `far_m` are ranges along the ray there."""
    normals: bool = False
    """Write nx ny nz into points.ply too."""


class DepthRequest(DepthOptions, Request):
    """Depth from projected patterns, a laser or time of flight."""

    capture: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="CAPTURE")]
    """Folder with a capture.json."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for depth.exr, points.ply and report.json."""
    tof: TofOptions = TofOptions()
    """How time of flight is solved, with the camera's calibration; `near_m` and `far_m` are ranges along the ray there."""
