"""The jobs that measure lights, cameras and projectors: `relit calibrate`, with identifiers of captures in place of paths."""

from typing import Annotated, Literal

from pydantic import Field

from service.requests import calibrate
from service.requests.base.base import CAPTURE, JobRequest, Role, Spelling
from service.requests.base.identifiers import CaptureId
from service.requests.chart import ChartOptions
from service.requests.drive import RIG, RigDocument
from service.requests.rig import RigCalibrationOptions
from stage.model import Line

MOST_CAPTURES = 100
"""The most captures that one field of a job names."""


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
    options: calibrate.MirrorBallOptions = calibrate.MirrorBallOptions()


class LightPositionsJob(BallJob):
    """Positions of near lights from two or more mirror balls: capture.json, calibration.json."""

    kind: Literal["calibrate-light-positions"]
    options: calibrate.LightPositionsOptions = calibrate.LightPositionsOptions()


class GreyBallJob(BallJob):
    """Brightness of each light from one grey ball: capture.json, calibration.json."""

    kind: Literal["calibrate-grey-ball"]
    options: calibrate.GreyBallOptions = calibrate.GreyBallOptions()


class IntensityJob(CalibrationJob):
    """Brightness of lights of known direction from images of the object itself: capture.json, calibration.json."""

    kind: Literal["calibrate-intensity"]
    options: calibrate.IntensityOptions = calibrate.IntensityOptions()


class DarkJob(JobRequest):
    """Mean of images with the lens covered: dark.exr, capture.json that names it, calibration.json."""

    kind: Literal["calibrate-dark"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture that the images lie in and belong to."""
    images: Annotated[tuple[Line, ...], Field(min_length=1), Role.INPUT, calibrate.IMAGES]
    """Names of the images in the capture's folder, of its resolution and encoding, at the exposure of its frames."""


class FlatFieldJob(JobRequest):
    """Mean of images of an evenly lit white card: flat.exr, capture.json that names it, calibration.json."""

    kind: Literal["calibrate-flat-field"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture that the images lie in and belong to."""
    images: Annotated[tuple[Line, ...], Field(min_length=1), Role.INPUT, calibrate.IMAGES]
    """Names of the images in the capture's folder, of its resolution and encoding."""
    dark_images: Annotated[tuple[Line, ...], Role.INPUT, Spelling(flag="--dark", metavar="NAME")] = ()
    """Name of a dark image at the exposure of the white card; may be repeated. Without it the dark frame of the capture is used."""


class WhiteBalanceJob(JobRequest):
    """Colours from a grey or white card: capture.json with `color_matrix`, calibration.json."""

    kind: Literal["calibrate-white-balance"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture that the images lie in and belong to."""
    images: Annotated[tuple[Line, ...], Field(min_length=1), Role.INPUT, calibrate.IMAGES]
    """Names of the images of the card in the capture's folder, of its resolution and encoding."""
    options: calibrate.WhiteBalanceOptions = calibrate.WhiteBalanceOptions()


class ChartJob(JobRequest):
    """Colours from a colour chart in the frames: capture.json with a matrix for each kind of light, chart.png, calibration.json."""

    kind: Literal["calibrate-chart"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture whose frames show the chart."""
    apply_to: Annotated[CaptureId | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Another capture of the same camera under the same kinds of light, whose manifest is written; None: the capture itself."""
    reflectances: Annotated[Line | None, Role.INPUT, Spelling(metavar="NAME")] = None
    """Name of the file in the capture's folder with the colours of the chart's patches: CGATS or CSV. None: those of the maker."""
    options: ChartOptions = ChartOptions()


class SaturationJob(JobRequest):
    """The level at which the readings of the frames saturate: capture.json with it, calibration.json."""

    kind: Literal["calibrate-saturation"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture."""


class ProcamJob(JobRequest):
    """Camera, projector and their pose from a chessboard under projected columns and rows: ID.capture.json for each capture,
    calibration.json."""

    kind: Literal["calibrate-procam"]
    captures: Annotated[tuple[CaptureId, ...], Field(min_length=1, max_length=MOST_CAPTURES), Role.INPUT, calibrate.POSES]
    """The captures, one for each pose of the board."""
    apply_to: Annotated[tuple[CaptureId, ...], Field(max_length=MOST_CAPTURES), Role.INPUT, Spelling(metavar="CAPTURE")] = ()
    """Another capture of the same rig, whose manifest is written too; may be repeated."""
    options: calibrate.ProcamOptions


class StereoCalibrationJob(JobRequest):
    """Several cameras and their poses from a chessboard that they see at the same moments: ID.capture.json for each capture,
    calibration.json."""

    kind: Literal["calibrate-stereo"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture, each of whose stereo frames shows the board in another pose."""
    apply_to: Annotated[tuple[CaptureId, ...], Field(max_length=MOST_CAPTURES), Role.INPUT, Spelling(metavar="CAPTURE")] = ()
    """Another capture of the same cameras, whose manifest is written too; may be repeated."""
    options: calibrate.BoardOptions


class LaserPlanesJob(JobRequest):
    """The planes of a laser from its stripes on a chessboard in two poses or more, or on a step of known height: ID.capture.json for each
    capture, calibration.json."""

    kind: Literal["calibrate-laser-planes"]
    captures: Annotated[tuple[CaptureId, ...], Field(min_length=1, max_length=MOST_CAPTURES), Role.INPUT, calibrate.POSES]
    """The captures, one for each pose of the board or step, the same laser frames in each; with a board also a frame without the laser."""
    apply_to: Annotated[tuple[CaptureId, ...], Field(max_length=MOST_CAPTURES), Role.INPUT, Spelling(metavar="CAPTURE")] = ()
    """Another capture under the same laser planes in the same order, whose manifest is written too; may be repeated."""
    options: calibrate.LaserPlanesOptions


class ResponseJob(JobRequest):
    """The projector's light at each level (its gamma), from images of evenly grey projections: capture.json, calibration.json."""

    kind: Literal["calibrate-response"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture: the images lie in its folder, its camera took them, its projector gets the response."""
    images: Annotated[tuple[Line, ...], Field(min_length=calibrate.LEAST_GREYS), Role.INPUT, calibrate.IMAGES]
    """Names of the images of evenly grey projections in the capture's folder."""
    options: calibrate.ResponseOptions = calibrate.ResponseOptions()


class TofCalibrationJob(JobRequest):
    """Wiggling, scale, offset and drift of a time-of-flight camera from captures of a flat target at known distances: tof.json."""

    kind: Literal["calibrate-tof"]
    capture: Annotated[CaptureId, Role.INPUT, Spelling(argument=True, metavar="SWEEP")]
    """A folder with the captures of the sweep, each in a folder of its own, and the relit.tof-sweep/1 file."""
    sweep: Annotated[Line, Role.INPUT, Spelling(metavar="NAME")] = "sweep.json"
    """Name of the relit.tof-sweep/1 file in the folder."""


class RigCalibrationJob(JobRequest):
    """Irradiance, colour and response of each primary of a rig, from a capture in which one shines at a time: measured.json (the rig),
    calibration.json, and of a colour chart chart.json."""

    kind: Literal["calibrate-rig"]
    capture: Annotated[CaptureId, Role.INPUT, CAPTURE]
    """The capture with a frame for each primary and level; its lights may be placeholders."""
    rig: Annotated[RigDocument, Role.INPUT, RIG]
    """The rig that was driven (JSON, schema relit.rig/1; docs/drive.md)."""
    table: Annotated[Line, Role.INPUT, Spelling(metavar="NAME")]
    """Name of the table in the capture's folder that says what each frame shows: CSV with the columns frame, light, primary, level."""
    masks: Annotated[tuple[Line, ...], Role.INPUT, Spelling(flag="--ball-mask", metavar="NAME")] = ()
    """Name of a mask image of the ball in the capture's folder, in place of `ball`."""
    reflectances: Annotated[Line | None, Role.INPUT, Spelling(metavar="NAME")] = None
    """Name of the table of the chart's reflectances in the capture's folder: CSV with the columns name, r, g, b."""
    options: RigCalibrationOptions = RigCalibrationOptions()


AnyCalibration = (MirrorBallJob | LightPositionsJob | GreyBallJob | IntensityJob | DarkJob | FlatFieldJob | SaturationJob | ProcamJob
                  | StereoCalibrationJob | ResponseJob | TofCalibrationJob | WhiteBalanceJob | ChartJob | LaserPlanesJob
                  | RigCalibrationJob)
"""Every kind of job that calibrates."""
