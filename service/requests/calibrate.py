"""The options of `relit calibrate`: one frozen model for each kind."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from service.requests.base.base import CAPTURE, Choice, Commas, CropBox, DeviceRequest, Options, Request, Role, Spelling, WidthHeight
from service.requests.base.option_values import (
    AlbedoText,
    Circle,
    CircleText,
    Corners,
    CornersText,
    LevelsText,
    MarkerSide,
    PartOfLight,
    SquareSide,
    StepHeight,
    refuse,
)
from stage.model import Count, Finite, Positive

IMAGES = Spelling(argument=True, metavar="IMAGE...")
POSES = Spelling(argument=True, metavar="CAPTURE...")
LEAST_GREYS = 3
"""The fewest images of evenly grey projections that a response is fitted to."""


class Markers(Choice):
    """A set of coded markers: of ArUco by the side of its grid, or an AprilTag family."""

    ARUCO4, ARUCO5, ARUCO6, ARUCO7 = "aruco4", "aruco5", "aruco6", "aruco7"
    APRILTAG16H5, APRILTAG25H9, APRILTAG36H11 = "apriltag16h5", "apriltag25h9", "apriltag36h11"


class LightsOptions(Options):
    """Base of what is chosen to measure lights."""

    drop_failed: bool = False
    """Leave out frames whose light cannot be measured, in place of refusing the capture."""


class BallOptions(LightsOptions):
    """Base of what is chosen to look at balls."""

    circles: Annotated[tuple[Annotated[Circle, CircleText], ...], Role.INPUT, Spelling(flag="--ball", metavar="U,V,R")] = ()
    """Outline of a ball: centre and radius in pixels. Give one for each ball; without it and without a mask, the balls are found
    in the images."""


class MirrorBallOptions(BallOptions):
    """Options for finding the highlight on a mirror ball."""

    level: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """The highlight on the ball is what is brighter than this fraction of its peak."""


class LightPositionsOptions(MirrorBallOptions):
    """Radii and distances of the mirror balls."""

    ball_radius_m: tuple[Positive, ...] = ()
    """Radius in metres, one for all balls or one for each; an orthographic camera with pixel_size_m needs none."""
    ball_z_m: tuple[Finite, ...] = ()
    """Camera-frame z of the centres in metres, for an orthographic camera; without it surface_z_m of the manifest, or 0."""


class GreyBallOptions(BallOptions):
    """Albedo, radius and distance of the grey ball."""

    albedo: Annotated[tuple[Positive, Positive, Positive] | None, AlbedoText, PartOfLight, Spelling(metavar="R,G,B")] = None
    """Albedo of the ball, one number or three; None: only ratios of irradiance are measured, and their mean is set to 1."""
    refine_direction: bool = False
    """Take the direction of distant lights from the shading, in place of the manifest."""
    ball_radius_m: Positive | None = None
    """Radius of the ball in metres, for point lights and a perspective camera."""
    ball_z_m: Finite | None = None
    """Camera-frame z of the ball's centre in metres, for point lights and an orthographic camera; None: surface_z_m of the
    manifest, or 0."""


class IntensityOptions(LightsOptions):
    """The number of pixels of the object that are used."""

    pixels: Annotated[int, Field(ge=100, le=100_000)] = 2000
    """Number of pixels of the mask, drawn at random, that are used: 100 to 100000."""


class LightsRequest(LightsOptions):
    """Base of the kinds that measure lights."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder of the capture with the calibration images; its distant and point lights may be placeholders."""
    apply_to: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Another capture under the same lights in the same order, whose manifest is written; None: the capture itself."""
    out: Annotated[Path | None, Role.FILE] = None
    """Manifest to write; None: the target's own capture.json."""


class BallRequest(BallOptions, LightsRequest):
    """Base of the kinds that look at balls: circles first, then masks."""

    masks: Annotated[tuple[Path, ...], Role.INPUT, Spelling(flag="--ball-mask")] = ()
    """Mask image of a ball, in place of `ball`; more precise. Give one for each ball."""


class MirrorBallRequest(MirrorBallOptions, BallRequest):
    """Directions of far lights from one mirror ball."""


class LightPositionsRequest(LightPositionsOptions, BallRequest):
    """Positions of near lights from two or more mirror balls."""


class GreyBallRequest(GreyBallOptions, BallRequest):
    """Brightness of each light from one grey ball."""


class IntensityRequest(IntensityOptions, LightsRequest):
    """Brightness of lights of known direction from images of the object itself."""


class ManifestRequest(Options):
    """Base of the kinds that change one value of a capture's manifest."""

    out: Annotated[Path | None, Role.FILE] = None
    """Manifest to write, with the files that the calibration makes beside it; None: the capture's own capture.json."""


class FramesRequest(ManifestRequest):
    """Base of the kinds that average images."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json."""
    images: Annotated[tuple[Path, ...], Role.INPUT, IMAGES]
    """Images to average, of the capture's resolution and encoding."""


class DarkRequest(FramesRequest):
    """The capture's dark.exr: mean of images with the lens covered, at the exposure of the frames."""


class FlatFieldRequest(FramesRequest):
    """The capture's flat.exr: mean of images of an evenly lit white card."""

    dark_images: Annotated[tuple[Path, ...], Role.INPUT, Spelling(flag="--dark")] = ()
    """A dark image at the exposure of the white card; may be repeated. Without it the dark frame of the capture is used."""


class WhiteBalanceOptions(Options):
    """Options for white balance by a grey or white card."""

    region: Annotated[CropBox | None, Commas, Spelling(metavar="X,Y,W,H")] = None
    """Part of the images that the card fills: first column, first row, width and height in pixels; None: all of it."""
    sensor_colors: bool = False
    """Keep the primaries of the sensor of camera raw files, in place of those of `color_space`: balance white alone."""


class WhiteBalanceRequest(WhiteBalanceOptions, FramesRequest):
    """The colours of the capture from a grey or white card in its light: white balance, and the colours of the sensor of camera raw."""


class SaturationRequest(ManifestRequest):
    """The level at which the readings of the frames saturate, from the top of their histogram."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json."""
    write: bool = False
    """Set `saturation` in the manifest, in place of only printing it; `out` sets it too."""


class MarkerOptions(Options):
    """The markers of a ChArUco board."""

    markers: Markers | None = None
    """Set of the coded markers in the white squares of a ChArUco board, which may be seen in part. None: it is a plain chessboard."""
    marker_m: Annotated[Positive | None, MarkerSide] = None
    """Side of a marker in metres, its black border included."""

    def check_markers(self, square_m: float | None) -> None:
        """Refuse markers without a side, without a board, or wider than its squares."""
        if (self.markers is None) != (self.marker_m is None):
            refuse("--markers and --marker-m belong together: give both for a ChArUco board, or neither for a chessboard")
        if self.marker_m is None:
            return
        if square_m is None:
            refuse("--markers are printed on a board: give --board and --square-m")
        if self.marker_m >= square_m:
            refuse(f"--marker-m {self.marker_m:g}: is not smaller than the squares (--square-m {square_m:g}), in which the markers lie")


class BoardOptions(MarkerOptions):
    """Corners and squares of the chessboard or ChArUco board."""

    board: Annotated[tuple[Corners, Corners], CornersText, Spelling(metavar="9x6")]
    """Inner corners of the board, across and down: one fewer than its squares."""
    square_m: Annotated[Positive, SquareSide]
    """Side of a square in metres."""

    @model_validator(mode="after")
    def _markers_fit(self) -> Self:
        self.check_markers(self.square_m)
        return self


class ProcamOptions(BoardOptions):
    """The chessboard, the size of the projector, and the treatment of outliers."""

    projector: Annotated[tuple[Count, Count] | None, WidthHeight, Spelling(metavar="1280x800")] = None
    """Width and height of the projector in pixels; None: as in the manifests."""
    drop_outliers: bool = False
    """Leave out poses whose error is much larger than that of the others, and fit again."""


class ProcamRequest(ProcamOptions, Request):
    """Camera, projector and their pose from a chessboard under projected columns and rows."""

    captures: Annotated[tuple[Path, ...], Field(min_length=1), Role.INPUT, POSES]
    """Folders with a capture.json, one for each pose of the board."""
    apply_to: Annotated[tuple[Path, ...], Role.INPUT, Spelling(metavar="CAPTURE")] = ()
    """Another capture of the same rig, whose manifest is written too; may be repeated."""


class StereoRequest(BoardOptions):
    """Several cameras and their poses from a chessboard that they see at the same moments."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json, each of whose stereo frames shows the board in another pose."""
    apply_to: Annotated[tuple[Path, ...], Role.INPUT, Spelling(metavar="CAPTURE")] = ()
    """Another capture of the same cameras, whose manifest is written too; may be repeated."""


class LaserPlanesOptions(MarkerOptions):
    """The target under the stripes of the laser: a chessboard or ChArUco board, or a step."""

    board: Annotated[tuple[Corners, Corners] | None, CornersText, Spelling(metavar="9x6")] = None
    """Inner corners of the board, across and down: one fewer than its squares."""
    square_m: Annotated[Positive | None, SquareSide] = None
    """Side of a square of the board in metres."""
    step_m: Annotated[Positive | None, StepHeight] = None
    """Height in metres of a right-angled block on a flat base, which needs no board."""
    drop_failed: bool = False
    """Leave out frames whose plane the boards do not tell, in place of refusing all of them."""

    @model_validator(mode="after")
    def _one_target(self) -> Self:
        if self.drop_failed and self.step_m is not None:
            refuse("--drop-failed is for boards: the planes on a step are found together")
        if (self.board is None) != (self.square_m is None):
            refuse("--board and --square-m belong together: give both, or --step-m")
        if (self.board is None) == (self.step_m is None):
            refuse("give --board and --square-m for a chessboard, or --step-m for a step of known height")
        self.check_markers(self.square_m)
        return self


class LaserPlanesRequest(LaserPlanesOptions, DeviceRequest):
    """The planes of a laser from its stripes on a chessboard in two poses or more, or on a step of known height, before a calibrated
    camera."""

    captures: Annotated[tuple[Path, ...], Field(min_length=1), Role.INPUT, POSES]
    """Folders with a capture.json, one for each pose of the board or step, the same laser frames in each; with a board also a frame
    without the laser."""
    apply_to: Annotated[tuple[Path, ...], Role.INPUT, Spelling(metavar="CAPTURE")] = ()
    """Another capture under the same laser planes in the same order, whose manifest is written too; may be repeated."""


class ResponseOptions(Options):
    """The levels of the images of evenly grey projections."""

    levels: Annotated[tuple[Annotated[float, Field(ge=0, le=1)], ...], LevelsText, Commas, Spelling(metavar="0,0.25,…")] = ()
    """Level of each image, 0 to 1; without it even steps from 0 to 1 in the order of the images."""


class ResponseRequest(ResponseOptions, ManifestRequest):
    """The projector's light at each level (its gamma), for ramps, from images of evenly grey projections."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json: its camera took the images, its projector gets the response."""
    images: Annotated[tuple[Path, ...], Field(min_length=LEAST_GREYS), Role.INPUT, IMAGES]
    """Images of evenly grey projections."""


class TofCalibrationRequest(DeviceRequest):
    """Wiggling, scale, offset and drift of a time-of-flight camera from captures of a flat target at known distances."""

    sweep: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SWEEP")]
    """A relit.tof-sweep/1 file: captures and their distances."""
    out: Annotated[Path, Role.FILE]
    """The relit.tof/1 file to write."""
