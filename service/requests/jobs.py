"""The jobs of the service: options as on the command line, with identifiers of captures and jobs in place of paths."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from service.requests.base import CAPTURE, Options, Role, Spelling
from service.requests.basis import BasisOptions
from service.requests.calibrate import (
    IMAGES,
    LEAST_GREYS,
    POSES,
    GreyBallOptions,
    IntensityOptions,
    LightPositionsOptions,
    MirrorBallOptions,
    ProcamOptions,
    ResponseOptions,
    StereoOptions,
)
from service.requests.depth import DepthOptions
from service.requests.export import AssetFormat, ExportOptions
from service.requests.identifiers import CaptureId, EnvironmentId, JobId
from service.requests.inspect_board import InspectBoardOptions
from service.requests.light_keys import LightKeys
from service.requests.patterns import PatternsOptions
from service.requests.relight import RelightOptions
from service.requests.scan import ScanOptions
from service.requests.shade import ShadeOptions
from service.requests.solve import SolveOptions
from service.requests.view import ViewOptions
from stage.model import Line

DEFAULT_PORT = 8470
DEFAULT_SERVER = f"http://127.0.0.1:{DEFAULT_PORT}"
"""The address at which a client looks for the service if it is given no other."""

MAPS = Spelling(argument=True, metavar="JOB")
KEYS = Spelling(metavar="FILE")
MOST_CAPTURES = 100
"""The most captures that one field of a job names."""


class JobRequest(Options):
    """Base of every job."""

    name: Annotated[str, Field(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$"), Role.RUN, Spelling(flag="--job-name", metavar="TEXT")] = ""
    """Name of the job, shown in lists; it need not be unique."""
    priority: Annotated[int, Field(ge=0, le=100), Role.RUN] = 50
    """0 to 100: jobs of higher priority are done first, those of equal priority in the order of submission."""


class CheckJob(JobRequest):
    """Whether a capture or environment can be used: manifest, headers and the size of images. Made by the service itself."""

    kind: Literal["check"]
    intake: Line


class SolveJob(JobRequest):
    """Normals, reflectance and height: maps.exr, report.json."""

    kind: Literal["solve"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""
    reference_ball: Annotated[CaptureId | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Capture of a ball of the object's material, for the method reference."""
    options: SolveOptions = SolveOptions()


class DepthJob(JobRequest):
    """Depth: depth.exr, points.ply, report.json."""

    kind: Literal["depth"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""
    tof_calibration: Annotated[Line | None, Role.INPUT, Spelling(metavar="NAME")] = None
    """Name of a relit.tof/1 file in the capture's folder."""
    options: DepthOptions = DepthOptions()


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


class ViewJob(JobRequest):
    """What a browser needs to show a capture and its maps: view.json, view.bin, thumbnails.jpg."""

    kind: Literal["view"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""
    maps: Annotated[JobId | None, Role.INPUT, Spelling(metavar="JOB")] = None
    """A solve, pipeline or depth job of the capture, or a join of such: its maps are shown too."""
    options: ViewOptions = ViewOptions()


class PipelineJob(JobRequest):
    """Solve, then export, then relight, in one job: maps.exr, report.json, asset.usdz and frame.####.exr; no frames without an environment
    or light keys."""

    kind: Literal["pipeline"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""
    environment: Annotated[EnvironmentId | None, Role.INPUT] = None
    """Lat-long environment."""
    keys: Annotated[LightKeys | None, Role.INPUT, KEYS] = None
    """Light keys (JSON, schema relit.keys/1; docs/relight.md)."""
    format: AssetFormat = "usdz"
    """Format of the asset."""
    guided: bool = False
    """Guide the frames by the maps that were solved."""
    solve: SolveOptions = SolveOptions()
    export: ExportOptions = ExportOptions()
    relight: RelightOptions = RelightOptions()


class BasisJob(JobRequest):
    """A capture as a few coefficient images: basis.exr, basis.ptm or basis.rti, and a .json beside it."""

    kind: Literal["basis"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""
    options: BasisOptions = BasisOptions()


class ScanJob(JobRequest):
    """Shots of a scanning laser as one point cloud: points.ply, points.usdc, report.json."""

    kind: Literal["scan"]
    capture: Annotated[CaptureId, Role.INPUT, Spelling(argument=True, metavar="SCAN")]
    """An uploaded folder with a scan.json."""
    options: ScanOptions = ScanOptions()


class InspectBoardJob(JobRequest):
    """What is wrong with a board that was measured in tiles: board.exr, deviation.exr, findings.csv, inspection.png, report.json."""

    kind: Literal["inspect-board"]
    capture: Annotated[CaptureId, Role.INPUT, Spelling(argument=True, metavar="BOARD")]
    """An uploaded folder with a board.json, each of whose tiles is a capture."""
    golden: Annotated[JobId | None, Role.INPUT, Spelling(metavar="JOB")] = None
    """The job that inspected a good board, with which this one is compared. None: only the height map is made."""
    options: InspectBoardOptions = InspectBoardOptions()


class PatternsJob(JobRequest):
    """Images to project and their manifest entries: PNG files and patterns.json."""

    kind: Literal["patterns"]
    options: PatternsOptions


class CalibrationJob(JobRequest):
    """Base of the jobs that measure lights: capture.json with the lights, calibration.json."""

    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture with the calibration images; its distant and point lights may be placeholders."""
    apply_to: Annotated[CaptureId | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Another capture under the same lights in the same order, whose manifest is written; None: the capture itself."""


class BallJob(CalibrationJob):
    """Base of the jobs that look at balls."""

    masks: Annotated[tuple[Line, ...], Role.INPUT, Spelling(flag="--ball-mask", metavar="NAME")] = ()
    """Name of a mask image of a ball in the capture's folder, in place of `ball`. Give one for each ball."""


class MirrorBallJob(BallJob):
    """Directions of far lights from one mirror ball: capture.json, calibration.json."""

    kind: Literal["calibrate-mirror-ball"]
    options: MirrorBallOptions = MirrorBallOptions()


class LightPositionsJob(BallJob):
    """Positions of near lights from two or more mirror balls: capture.json, calibration.json."""

    kind: Literal["calibrate-light-positions"]
    options: LightPositionsOptions = LightPositionsOptions()


class GreyBallJob(BallJob):
    """Brightness of each light from one grey ball: capture.json, calibration.json."""

    kind: Literal["calibrate-grey-ball"]
    options: GreyBallOptions = GreyBallOptions()


class IntensityJob(CalibrationJob):
    """Brightness of lights of known direction from images of the object itself: capture.json, calibration.json."""

    kind: Literal["calibrate-intensity"]
    options: IntensityOptions = IntensityOptions()


class DarkJob(JobRequest):
    """Mean of images with the lens covered: dark.exr, capture.json that names it, calibration.json."""

    kind: Literal["calibrate-dark"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture that the images lie in and belong to."""
    images: Annotated[tuple[Line, ...], Field(min_length=1), Role.INPUT, IMAGES]
    """Names of the images in the capture's folder, of its resolution and encoding, at the exposure of its frames."""


class FlatFieldJob(JobRequest):
    """Mean of images of an evenly lit white card: flat.exr, capture.json that names it, calibration.json."""

    kind: Literal["calibrate-flat-field"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture that the images lie in and belong to."""
    images: Annotated[tuple[Line, ...], Field(min_length=1), Role.INPUT, IMAGES]
    """Names of the images in the capture's folder, of its resolution and encoding."""
    dark_images: Annotated[tuple[Line, ...], Role.INPUT, Spelling(flag="--dark", metavar="NAME")] = ()
    """Name of a dark image at the exposure of the white card; may be repeated. Without it the dark frame of the capture is used."""


class SaturationJob(JobRequest):
    """The level at which the readings of the frames saturate: capture.json with it, calibration.json."""

    kind: Literal["calibrate-saturation"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""


class ProcamJob(JobRequest):
    """Camera, projector and their pose from a chessboard under projected columns and rows: ID.capture.json for each capture,
    calibration.json."""

    kind: Literal["calibrate-procam"]
    captures: Annotated[tuple[CaptureId, ...], Field(min_length=1, max_length=MOST_CAPTURES), Role.INPUT, POSES]
    """The captures, one for each pose of the board."""
    apply_to: Annotated[tuple[CaptureId, ...], Field(max_length=MOST_CAPTURES), Role.INPUT, Spelling(metavar="CAPTURE")] = ()
    """Another capture of the same rig, whose manifest is written too; may be repeated."""
    options: ProcamOptions


class StereoCalibrationJob(JobRequest):
    """Several cameras and their poses from a chessboard that they see at the same moments: ID.capture.json for each capture,
    calibration.json."""

    kind: Literal["calibrate-stereo"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture, each of whose stereo frames shows the board in another pose."""
    apply_to: Annotated[tuple[CaptureId, ...], Field(max_length=MOST_CAPTURES), Role.INPUT, Spelling(metavar="CAPTURE")] = ()
    """Another capture of the same cameras, whose manifest is written too; may be repeated."""
    options: StereoOptions


class ResponseJob(JobRequest):
    """The projector's light at each level (its gamma), from images of evenly grey projections: capture.json, calibration.json."""

    kind: Literal["calibrate-response"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture: the images lie in its folder, its camera took them, its projector gets the response."""
    images: Annotated[tuple[Line, ...], Field(min_length=LEAST_GREYS), Role.INPUT, IMAGES]
    """Names of the images of evenly grey projections in the capture's folder."""
    options: ResponseOptions = ResponseOptions()


class TofCalibrationJob(JobRequest):
    """Wiggling, scale, offset and drift of a time-of-flight camera from captures of a flat target at known distances: tof.json."""

    kind: Literal["calibrate-tof"]
    capture: Annotated[CaptureId, Role.INPUT, Spelling(argument=True, metavar="SWEEP")]
    """A folder with the captures of the sweep, each in a folder of its own, and the relit.tof-sweep/1 file."""
    sweep: Annotated[Line, Role.INPUT, Spelling(metavar="NAME")] = "sweep.json"
    """Name of the relit.tof-sweep/1 file in the folder."""


OneJob = (SolveJob | DepthJob | JoinJob | RelightJob | ShadeJob | ExportJob | ViewJob | PipelineJob | BasisJob | ScanJob
          | InspectBoardJob | PatternsJob | MirrorBallJob | LightPositionsJob | GreyBallJob | IntensityJob | DarkJob | FlatFieldJob
          | SaturationJob | ProcamJob | StereoCalibrationJob | ResponseJob | TofCalibrationJob)
UserJob = Annotated[OneJob, Field(discriminator="kind")]
"""Every kind of job that the API accepts."""
AnyJob = Annotated[CheckJob | OneJob, Field(discriminator="kind")]
ANY_JOB: TypeAdapter[CheckJob | OneJob] = TypeAdapter(AnyJob)
