"""What can be asked of `relit depth`: one frozen model."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.methods import Ranging
from service.requests import Options, Request
from service.tof_options import TofChoices, TofOptions

Above0 = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


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
