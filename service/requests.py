"""What can be asked of Relit: one frozen model a job, the same object for the command line, the API and the workflow."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from service.methods import Method


class Request(BaseModel):
    """Base of every request."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    device: str | None = None
    """cpu, cuda:0, …; None: the first CUDA device, else the CPU."""
    cache: Path | None = None
    """Folder for the stack cache; None: `.relit` in the capture's folder."""


class StackRequest(Request):
    """Base of requests on the images of a capture."""

    align: bool = False
    """Warp the frames of a moving subject to the time of one tracking frame."""
    align_to: str | None = None
    """Image of that tracking frame, and so `align`; None: the middle one."""

    @property
    def aligned(self) -> bool:
        """Whether frames are warped."""
        return self.align or self.align_to is not None


class SolveRequest(StackRequest):
    """Normals, albedo and height of a capture."""

    capture: Path
    out: Path
    """Folder for maps.exr and report.json."""
    method: Method | None = None
    """None: gradient where there are gradient frames; else svbrdf where there are lights enough, else robust."""
    reference_ball: Path | None = None
    """Capture of a ball of the object's material under the same lights, for the method reference."""


class RelightRequest(StackRequest):
    """Frames of a capture under a lat-long environment."""

    capture: Path
    environment: Path
    out: str
    """Path of the frames with #### for the number."""
    frames: str = "1"
    """A number, or first-last."""
    spin_degrees: float = Field(default=0.0, allow_inf_nan=False)
    """How far the environment turns about +y over the whole range; the first frame is unturned, and a full turn closes."""


class ExportRequest(BaseModel):
    """A USD asset from solved maps."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    maps: Path
    """A folder with maps.exr, or the file."""
    out: Path
    """.usdz, .usda or .usdc."""
    name: str | None = None
    """Of the asset; None: what the maps say, else the file's stem."""
