"""The jobs of the service: options as on the command line, with identifiers of captures and jobs in place of paths."""

import re
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, TypeAdapter, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from service.requests.base.base import CAPTURE, JobRequest, Role, SequenceOptions, Spelling
from service.requests.base.identifiers import JOB, CaptureId, EnvironmentId, JobId, pattern
from service.requests.basis import BasisOptions
from service.requests.calibration_jobs import AnyCalibration
from service.requests.captures import ViewOptions
from service.requests.depth import DepthOptions, ScanOptions, SeparateOptions
from service.requests.drive import RIG, ChartDocument, DriveOptions, RigDocument
from service.requests.export import AssetFormat, ExportOptions
from service.requests.imports.layouts import ImportChoices
from service.requests.inspect_board import InspectBoardOptions
from service.requests.light.light_keys import LightKeys
from service.requests.patterns import PatternsOptions
from service.requests.register import FuseOptions, RegisterOptions
from service.requests.relight import RelightOptions
from service.requests.shade import ShadeOptions
from service.requests.solve import SolveOptions
from stage.colour.colour_spaces import names_as_given
from stage.model import Count, Line
from stage.sets.board import BoardRegions, GaugeRuns

MAPS = Spelling(argument=True, metavar="JOB")
KEYS = Spelling(metavar="FILE")
MOST_SCANS = 500
"""The most depths that one job registers."""


class CheckJob(JobRequest):
    """Check that a capture or environment can be used: manifest, headers and the size of images; before that, import files without a
    manifest, or only look what they are. The service makes this job on its own."""

    kind: Literal["check"]
    intake: Line
    guess: bool = False
    """Whether to look what the files are, and to propose an import, in place of a check."""
    importing: ImportChoices | None = None
    """The import of the files that is done before the check; None: they have a manifest."""


class SolveJob(JobRequest):
    """Normals, reflectance and height: maps.exr, report.json; of a sequence those of each step, sequence.json and report.json."""

    kind: Literal["solve"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture, or a sequence: an uploaded or registered folder of captures, one a time step (docs/sequences.md)."""
    reference_ball: Annotated[CaptureId | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Capture of a ball of the object's material, for the method reference."""
    options: SolveOptions = SolveOptions()
    sequence: SequenceOptions = SequenceOptions()


class DepthJob(JobRequest):
    """Depth: depth.exr, points.ply, report.json; of a sequence those of each step, sequence.json and report.json."""

    kind: Literal["depth"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture, or a sequence: an uploaded or registered folder of captures, one a time step (docs/sequences.md)."""
    tof_calibration: Annotated[Line | None, Role.INPUT, Spelling(metavar="NAME")] = None
    """Name of a relit.tof/1 file in the capture's folder."""
    beside: Annotated[CaptureId | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Capture of a second camera under the same patterns of the same projector, which need not be calibrated: both cameras are triangulated
    by their `world_from_camera`."""
    options: DepthOptions = DepthOptions()
    sequence: SequenceOptions = SequenceOptions()


class RelightJob(JobRequest):
    """Frames of a capture under new light: frame.####.exr."""

    kind: Literal["relight"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""
    environment: Annotated[EnvironmentId | None, Role.INPUT] = None
    """Lat-long environment."""
    keys: Annotated[LightKeys | None, Role.INPUT, KEYS] = None
    """Light keys (JSON, schema relit.keys/1; docs/relight.md)."""
    maps: Annotated[JobId | None, Role.INPUT, Spelling(metavar="JOB")] = None
    """A solve job of the capture: its maps guide the frames."""
    options: RelightOptions = RelightOptions()


class ShadeJob(JobRequest):
    """One picture of solved maps: picture.exr."""

    kind: Literal["shade"]
    maps: Annotated[JobId, Role.INPUT, MAPS]
    """The job that made the maps."""
    environment: Annotated[EnvironmentId | None, Role.INPUT] = None
    """Lat-long environment."""
    capture: Annotated[CaptureId | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """The capture of the maps: its images add what a model of the maps lacks, such as interreflection."""
    options: ShadeOptions = ShadeOptions()


class ExportJob(JobRequest):
    """An asset of a solve or depth job: asset.usdz, .usda, .usdc or .glb."""

    kind: Literal["export"]
    maps: Annotated[JobId, Role.INPUT, MAPS]
    """The job that made the maps or the depth."""
    rig: Annotated[CaptureId | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Capture that was solved: its lights come along as UsdLux lights whose intensities replay it, as a variant that is off."""
    environment: Annotated[EnvironmentId | None, Role.INPUT] = None
    """Lat-long environment: it comes along as a DomeLight, as a variant that is off."""
    format: AssetFormat = "usdz"
    """Format of the asset."""
    options: ExportOptions = ExportOptions()


class JoinJob(JobRequest):
    """One surface from the maps of a solve and a depth of the same view: maps.exr, report.json."""

    kind: Literal["join"]
    maps: Annotated[JobId, Role.INPUT, MAPS]
    """The job that solved the maps."""
    depth: Annotated[JobId, Role.INPUT, Spelling(argument=True, metavar="JOB")]
    """The job that decoded the depth, by the same camera from the same place."""


class RegisterJob(JobRequest):
    """The poses of depths of one object, taken from several places: scan-set.json, report.json."""

    kind: Literal["register"]
    depths: Annotated[tuple[JobId, ...], Field(min_length=2, max_length=MOST_SCANS), Role.INPUT, Spelling(argument=True, metavar="JOB...")]
    """The jobs that decoded the depths. Their identifiers are the names of the scans; `world_from_camera` of a capture starts its pose."""
    solves: Annotated[tuple[JobId, ...], Field(max_length=MOST_SCANS), Role.INPUT, Spelling(metavar="JOB")] = ()
    """The jobs that solved (or joined) maps by the same cameras, one for each depth in its order, or none; may be repeated."""
    options: RegisterOptions = RegisterOptions()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.solves and len(self.solves) != len(self.depths):
            raise ValueError(f"solves: has {len(self.solves)} jobs for {len(self.depths)} depths: give one for each, or none")
        if len(set(self.depths)) < len(self.depths):
            raise ValueError("depths: names a job twice")
        return self


class FuseJob(JobRequest):
    """One mesh of registered depths: mesh.ply, asset.usdc with its textures, report.json; or site.usda and tiles."""

    kind: Literal["fuse"]
    registered: Annotated[JobId, Role.INPUT, Spelling(argument=True, metavar="JOB")]
    """The job that registered the depths."""
    options: FuseOptions = FuseOptions()


class ViewJob(JobRequest):
    """Write the files that a browser needs to show a capture and its maps: view.json, view.bin, and small pictures."""

    kind: Literal["view"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture, or a sequence of captures."""
    maps: Annotated[JobId | None, Role.INPUT, Spelling(metavar="JOB")] = None
    """A solve, pipeline or depth job of the capture, or a join of such: its maps are shown too."""
    step: Annotated[Count | None, Role.INPUT] = None
    """Number of the time step that is shown, from 1, where the capture is a sequence."""
    options: ViewOptions = ViewOptions()


class PipelineJob(JobRequest):
    """Solve, then export, then relight, in one job: maps.exr, report.json, asset.usdz and frame.####.exr; no frames without an environment
    or light keys."""

    kind: Literal["pipeline"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture, or a sequence: a folder of captures, one a time step."""
    environment: Annotated[EnvironmentId | None, Role.INPUT] = None
    """Lat-long environment."""
    keys: Annotated[LightKeys | None, Role.INPUT, KEYS] = None
    """Light keys (JSON, schema relit.keys/1; docs/relight.md)."""
    format: AssetFormat = "usdz"
    """Format of the asset."""
    guided: bool = False
    """Guide the frames by the maps that were solved."""
    solve: SolveOptions = SolveOptions()
    sequence: SequenceOptions = SequenceOptions()
    export: ExportOptions = ExportOptions()
    relight: RelightOptions = RelightOptions()


class BasisJob(JobRequest):
    """A capture as a few coefficient images: basis.exr, basis.ptm or basis.rti, and a .json beside it."""

    kind: Literal["basis"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""
    options: BasisOptions = BasisOptions()


class SeparateJob(JobRequest):
    """Direct and global light of a capture under fine, shifted phase patterns: separation.exr, report.json."""

    kind: Literal["separate"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""
    options: SeparateOptions = SeparateOptions()


class ScanJob(JobRequest):
    """Shots of a scanning laser as one point cloud: points.ply, points.usdc, report.json."""

    kind: Literal["scan"]
    capture: Annotated[CaptureId, Role.INPUT, Spelling(argument=True, metavar="SCAN")]
    """An uploaded folder with a scan.json."""
    options: ScanOptions = ScanOptions()


class InspectBoardJob(JobRequest):
    """Find the defects of a board that was measured in tiles: board.exr, deviation.exr, findings.csv, inspection.png, report.json."""

    kind: Literal["inspect-board"]
    capture: Annotated[CaptureId, Role.INPUT, Spelling(argument=True, metavar="BOARD")]
    """An uploaded folder with a board.json, each of whose tiles is a capture."""
    golden: Annotated[JobId | None, Role.INPUT, Spelling(metavar="JOB")] = None
    """The job that inspected a good board, with which this one is compared. None: only the height map is made."""
    regions: Annotated[BoardRegions | None, Role.INPUT, Spelling(metavar="FILE")] = None
    """Tolerance regions that are judged on the golden board (JSON, schema relit.board-regions/1; docs/inspection.md)."""
    options: InspectBoardOptions = InspectBoardOptions()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.regions is not None and self.golden is None:
            raise ValueError("regions are given without golden: they are judged on the height map of a good board")
        return self


class GaugeBoardJob(JobRequest):
    """Repeatability and reproducibility of inspections of the same boards (gauge R&R): gauge.csv, report.json."""

    kind: Literal["gauge-board"]
    study: Annotated[GaugeRuns, Role.INPUT, Spelling(argument=True, metavar="STUDY")]
    """The job, board and operator of each inspection (JSON, schema relit.gauge-study/1; docs/inspection.md)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for number, run in enumerate(self.study.runs):
            if re.fullmatch(pattern(JOB), run.result) is None:
                raise ValueError(f"study: runs[{number}].result: is {run.result}: give the identifier of the job that inspected the board")
        return self


class DriveJob(JobRequest):
    """Levels at which the lamps of a rig light a subject as an environment would: cues.csv, cues.json, report.json, preview.png, and with a
    capture predicted.####.exr."""

    kind: Literal["drive"]
    rig: Annotated[RigDocument, Role.INPUT, RIG]
    """The rig (JSON, schema relit.rig/1; docs/drive.md)."""
    environment: Annotated[EnvironmentId | None, Role.INPUT] = None
    """Lat-long environment."""
    keys: Annotated[LightKeys | None, Role.INPUT, KEYS] = None
    """Light keys (JSON, schema relit.keys/1; docs/relight.md)."""
    chart: Annotated[ChartDocument | None, Role.INPUT, Spelling(metavar="FILE")] = None
    """Chart (JSON, schema relit.chart/1; docs/drive.md): what the camera sees of its patches under each primary."""
    capture: Annotated[CaptureId | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """A capture under single lights from where the lamps stand, which is shown at the levels of each frame."""
    options: DriveOptions = DriveOptions()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.keys is not None and self.keys.captured:
            raise ValueError("keys: has captured images, which lamps cannot show: take them out")
        return self


class PatternsJob(JobRequest):
    """Images to project and their manifest entries: PNG files and patterns.json."""

    kind: Literal["patterns"]
    options: PatternsOptions


def _read_stored(given: Any, read: ValidatorFunctionWrapHandler) -> Any:
    with names_as_given():
        return read(given)


OneJob = (SolveJob | DepthJob | RelightJob | ShadeJob | ExportJob | ViewJob | PipelineJob | BasisJob | SeparateJob | ScanJob | PatternsJob
          | InspectBoardJob | GaugeBoardJob | DriveJob | JoinJob | RegisterJob | FuseJob | AnyCalibration)
UserJob = Annotated[OneJob, Field(discriminator="kind")]
"""Every kind of job that the API accepts."""
JOBS: dict[str, type[JobRequest]] = {get_args(model.model_fields["kind"].annotation)[0]: model for model in get_args(OneJob)}
"""The same by `kind`."""
AnyJob = Annotated[CheckJob | OneJob, Field(discriminator="kind")]
StoredJob = Annotated[AnyJob, WrapValidator(_read_stored)]
"""A job that a service has checked: its colour spaces are those of the service, which the reader's configuration may lack."""
ANY_JOB: TypeAdapter[CheckJob | OneJob] = TypeAdapter(AnyJob)
