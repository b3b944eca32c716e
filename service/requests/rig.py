"""The options of `relit rig` and of `relit calibrate rig`."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from service.requests.base.base import CAPTURE, Choice, Commas, CropBox, Options, Role, Spelling
from service.requests.base.option_values import AlbedoText, PartOfLight
from service.requests.calibrate import MirrorBallOptions
from service.requests.drive import RIG
from service.requests.light.picture_options import FrameRate
from service.requests.play import Protocol
from stage.model import Count, Finite, FirstFault, Line, NotNegativeCount, Positive


class Primaries(Choice):
    """The primaries of the lamps of a rig that is made from a capture."""

    RGB = "rgb", "red, green and blue, each with its channel of the irradiance of the captured light"
    WHITE = "white", "one, with the whole irradiance of the captured light"


class PatchOptions(Options):
    """The addresses of new lamps, which are patched one after another."""

    protocol: Protocol = Protocol.SACN
    """The protocol of all lamps."""
    universe: NotNegativeCount = 1
    """The first universe; a lamp whose channels would not fit begins the next."""
    bits: Literal[8, 16] = 16
    """The bits of a level: 8, or 16 on two channels."""
    host: Line | None = None
    """The address of the node of all lamps, such as 127.0.0.1 for relit twin; None: multicast for sacn, broadcast for artnet."""


class RigCheckRequest(Options):
    """Say what a rig holds, and what is wrong with it."""

    rig: Annotated[Path, Role.INPUT, RIG]
    """The rig (JSON, schema relit.rig/1); docs/drive.md."""
    picture: Annotated[Path | None, Role.FILE, Spelling(metavar="FILE.png")] = None
    """Write a picture of the dome."""


class RigFromCaptureRequest(PatchOptions):
    """Write the rig of the lamps that lit a capture: their directions or places, and their irradiances."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json, a frame for each lamp."""
    out: Annotated[Path, Role.FILE]
    """The rig file."""
    primaries: Primaries = Primaries.RGB
    """The primaries of every lamp."""


class RigFromCsvRequest(PatchOptions):
    """Write the rig of a table of lamps: CSV with the columns name, x, y, z, and optionally universe, channel and irradiance."""

    table: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="TABLE.csv")]
    """The table; x, y and z in the camera frame: x to the right, y up, z towards the viewer."""
    out: Annotated[Path, Role.FILE]
    """The rig file."""
    places: bool = False
    """x, y and z are places in metres, and not directions."""
    primaries: Annotated[tuple[Line, ...], FirstFault, Commas, Spelling(metavar="NAMES")] = ("red", "green", "blue")
    """The names of the primaries of every lamp, in the order of their channels; red, green and blue, white (all three), or amber."""
    irradiance: Positive = 1.0
    """The irradiance of every primary at the subject at full level, where the table has none."""


class RigFromMvrRequest(Options):
    """Write the rig of the fixtures of a scene in MVR, by the GDTF files in it: places, colours of emitters and addresses."""

    scene: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCENE.mvr")]
    """The scene, with the GDTF files of its fixtures; needs pymvr and pygdtf: pip install 'relit[set]'."""
    out: Annotated[Path, Role.FILE]
    """The rig file."""
    subject: Annotated[tuple[Finite, Finite, Finite], Commas, Spelling(metavar="X,Y,Z")] = (0.0, 0.0, 0.0)
    """The place of the subject in the scene, in metres: z up, as in the scene."""
    protocol: Protocol = Protocol.SACN
    """The protocol of all lamps."""
    universe: NotNegativeCount = 1
    """The number that the protocol gives to universe 1 of the scene; the others follow it."""
    irradiance: Positive = 1.0
    """The luminance of the irradiance of every lamp at the subject with all its primaries at full level; a scene has none."""


class RigSweepRequest(Options):
    """Cues that light one primary after another at several levels, for `relit play` while a camera takes an image of each."""

    rig: Annotated[Path, Role.INPUT, RIG]
    """The rig (JSON, schema relit.rig/1); docs/drive.md."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder of the results: cues.json, and cues.csv for `relit calibrate rig`."""
    levels: Annotated[int, Field(ge=1, le=256)] = 5
    """Even drives of each primary, the last at full; 1: full level alone, which measures no response."""
    lights: Annotated[tuple[Line, ...], Spelling(flag="--light", metavar="NAME")] = ()
    """A lamp to light; may be given several times. None: all."""
    frames_per_second: FrameRate = 0.5
    """Frames per second."""


class RigPlanRequest(Options):
    """Say what domes of so many lamps achieve under environments, before one is built."""

    environment: Annotated[tuple[Path, ...], Role.INPUT, Spelling(metavar="MAP")] = Field(min_length=1)
    """Lat-long environment maps, .exr or .hdr; may be given several times."""
    lights: Annotated[tuple[Count, ...], FirstFault, Commas, Spelling(metavar="COUNTS")] = (32, 64, 128, 331)
    """Numbers of lamps, with commas between; they are spread evenly over the sphere."""
    rigs: Annotated[tuple[Path, ...], Role.INPUT, Spelling(flag="--rig", metavar="RIG")] = ()
    """Rigs to judge beside them, by the directions of their lamps (relit.rig/1); may be given several times."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder of the results: plan.csv and plan.png."""


GridCount = Annotated[int, Field(ge=2, le=100)]


class RigTarget(Choice):
    """The target from which the lamps of a rig are measured."""

    GREY_BALL = "grey-ball", "a matt ball of known albedo"
    MIRROR_BALL = "mirror-ball", "a mirror ball, in which no lamp is saturated"
    CARD = "card", "a grey card, or a neutral patch of a colour chart"
    CHART = "chart", "a colour chart of known reflectances, whose readings under each primary `relit drive --chart` takes"


class RigCalibrationOptions(MirrorBallOptions):
    """The target in the images of a rig's lamps."""

    target: RigTarget = RigTarget.GREY_BALL
    """What the lamps light."""
    region: Annotated[CropBox | None, Commas, Spelling(metavar="X,Y,W,H")] = None
    """Part of the images that the card fills: first column, first row, width and height in pixels."""
    card_normal: Annotated[tuple[Finite, Finite, Finite], Commas, Spelling(metavar="X,Y,Z")] = (0.0, 0.0, 1.0)
    """The direction in which the card or chart faces, in the camera frame; 0,0,1: towards the camera."""
    corners: Annotated[tuple[Finite, ...], Field(min_length=8, max_length=8), Commas, Spelling(metavar="U,V,…")] | None = None
    """Pixels of the centres of four patches of the chart: the first, the last of the first row, the last, and the first of the last row."""
    grid: Annotated[tuple[GridCount, GridCount], Commas, Spelling(metavar="COLUMNS,ROWS")] = (6, 4)
    """Columns and rows of the chart's patches."""
    albedo: Annotated[tuple[Positive, Positive, Positive] | None, AlbedoText, PartOfLight, Spelling(metavar="R,G,B")] = None
    """Albedo of the ball or card, reflectance of the mirror, one number or three; None: the mean of all irradiances is set to 1."""


class RigCalibrationRequest(RigCalibrationOptions):
    """Irradiance, colour and response of each primary of a rig, from a capture in which one primary shines at a time."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder of a capture with a frame for each primary and level; its lights may be placeholders."""
    rig: Annotated[Path, Role.INPUT, RIG]
    """The rig that was driven (JSON, schema relit.rig/1); docs/drive.md."""
    table: Annotated[Path, Role.INPUT, Spelling(metavar="TABLE.csv")]
    """What each frame shows: CSV with the columns frame, light, primary, level, as the cues.csv of `relit rig sweep`; a frame is an
    image, or its number in the capture from 1."""
    out: Annotated[Path, Role.FILE]
    """The rig file to write, with calibration.json beside it, and chart.json where a chart is the target."""
    masks: Annotated[tuple[Path, ...], Role.INPUT, Spelling(flag="--ball-mask")] = ()
    """Mask image of the ball, in place of `ball`; more precise."""
    reflectances: Annotated[Path | None, Role.INPUT, Spelling(metavar="FILE.csv")] = None
    """The chart's reflectances in the capture's colour space: CSV with the columns name, r, g, b, its patches in reading order."""
