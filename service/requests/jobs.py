"""What a job of the service is asked: options as on the command line, and names of captures and jobs in place of paths."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from service.requests.base import Options
from service.requests.depth import DepthOptions
from service.requests.export import ExportOptions
from service.requests.identifiers import CaptureId, EnvironmentId, JobId
from service.requests.light_keys import LightKeys
from service.requests.relight import RelightOptions
from service.requests.shade import ShadeOptions
from service.requests.solve import SolveOptions

DEFAULT_PRIORITY = 50


class JobRequest(Options):
    """Base of every job."""

    name: Annotated[str, Field(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")] = ""
    """For people; nothing depends on it."""
    priority: Annotated[int, Field(ge=0, le=100)] = DEFAULT_PRIORITY
    """Higher goes first; equal ones in the order they came."""


class CheckJob(JobRequest):
    """Whether a capture or environment can be used: manifest, headers and the size of images. Made by the service itself."""

    kind: Literal["check"]
    intake: str


class SolveJob(JobRequest):
    """Normals, reflectance and height: maps.exr, report.json."""

    kind: Literal["solve"]
    capture: CaptureId
    reference_ball: CaptureId | None = None
    """Capture of the ball, for the method reference."""
    options: SolveOptions = SolveOptions()


class DepthJob(JobRequest):
    """Depth: depth.exr, points.ply, report.json."""

    kind: Literal["depth"]
    capture: CaptureId
    tof_calibration: str | None = None
    """Name of a relit.tof/1 file in the capture."""
    options: DepthOptions = DepthOptions()


class RelightJob(JobRequest):
    """Frames of a capture under new light: frame.####.exr."""

    kind: Literal["relight"]
    capture: CaptureId
    environment: EnvironmentId | None = None
    keys: LightKeys | None = None
    maps: JobId | None = None
    """A solve job of the capture: its maps guide the frames."""
    options: RelightOptions = RelightOptions()


class ShadeJob(JobRequest):
    """One picture of solved maps: picture.exr."""

    kind: Literal["shade"]
    maps: JobId
    environment: EnvironmentId | None = None
    capture: CaptureId | None = None
    """The capture of the maps: its images give what a model of the maps cannot."""
    options: ShadeOptions = ShadeOptions()


class ExportJob(JobRequest):
    """A USD asset of a solve or depth job: asset.usdz, .usda or .usdc."""

    kind: Literal["export"]
    maps: JobId
    format: Literal["usdz", "usda", "usdc"] = "usdz"
    options: ExportOptions = ExportOptions()


class PipelineJob(JobRequest):
    """Solve, then export, then relight: maps.exr, report.json, asset.usdz, frame.####.exr."""

    kind: Literal["pipeline"]
    capture: CaptureId
    environment: EnvironmentId | None = None
    keys: LightKeys | None = None
    format: Literal["usdz", "usda", "usdc"] = "usdz"
    guided: bool = False
    """Guide the frames by the maps that were solved."""
    solve: SolveOptions = SolveOptions()
    export: ExportOptions = ExportOptions()
    relight: RelightOptions = RelightOptions()


UserJob = Annotated[SolveJob | DepthJob | RelightJob | ShadeJob | ExportJob | PipelineJob, Field(discriminator="kind")]
"""What may be asked for through the API."""
AnyJob = Annotated[CheckJob | SolveJob | DepthJob | RelightJob | ShadeJob | ExportJob | PipelineJob, Field(discriminator="kind")]
ANY_JOB: TypeAdapter[CheckJob | SolveJob | DepthJob | RelightJob | ShadeJob | ExportJob | PipelineJob] = TypeAdapter(AnyJob)
