"""The options of `relit import` for images of projected patterns and of laser stripes."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from service.requests.base.base import Choice, Commas, Options, Role, Spelling, WidthHeight
from service.requests.imports.base import Axes, EncodingOptions, ImageOptions, ImportRequest, LensOptions
from service.requests.patterns import PatternAxis, Side
from stage.colour.colour_spaces import ColorSpaceName
from stage.model import Count, Finite, Line, Positive, Resolution


class OpencvGrayImport(ImportRequest):
    """Images of a Gray code in the order of OpenCV's GrayCodePattern: columns and rows, each with its inverse, then white and black."""

    projector: Annotated[Resolution, WidthHeight, Spelling(metavar="1280x800")]
    """Width and height of the projector in pixels, which say how many bits there are."""
    calibration: Annotated[Path | None, Role.INPUT] = None
    """OpenCV file (.yml, .xml, .json) with the intrinsics of camera and projector, R and T; relit calibrate procam measures them without
    such a file."""
    unit_m: Positive = 1.0
    """Metres in one unit of T, such as 0.001 for millimetres."""


class PlaneForm(Choice):
    """The equation to which the four coefficients of a plane belong."""

    ZERO = "zero", "a x + b y + c z + d = 0"
    EQUALS = "equals", "a x + b y + c z = d"


class LaserImport(LensOptions, ImageOptions, ImportRequest):
    """Images of the stripe of a laser on a scene that stands still, one for each place of its plane."""

    camera: Annotated[Path | None, Role.INPUT] = None
    """File with the matrix of the camera: an OpenCV file (.yml, .xml, .json), or K of a .mat file; None: as the other options say."""
    planes: Annotated[Path | None, Role.INPUT] = None
    """File with the plane of each image: rows of four coefficients, or of a point and a normal (.csv, .txt, .npy, .mat), or a calibration
    file with them; None: relit calibrate laser-planes measures them."""
    form: PlaneForm | None = None
    """The equation to which four coefficients of a plane belong."""
    axes: Axes | None = None
    """Where x, y and z of the planes point as seen by the camera, whose centre is their origin; OpenCV has right,down,away. Needed with
    planes."""
    unit_m: Positive | None = None
    """Metres in one unit of the planes, such as 0.001 for millimetres. Needed with planes."""

    @model_validator(mode="after")
    def _of_the_planes(self) -> Self:
        if self.planes is not None and (self.axes is None or self.unit_m is None):
            raise ValueError(f"--planes {self.planes}: needs --axes, right,down,away for OpenCV's, and --unit-m, 0.001 for millimetres")
        if self.planes is None and (self.axes is not None or self.unit_m is not None or self.form is not None):
            raise ValueError("--axes, --unit-m and --form are those of --planes, which is not given")
        return self


class RigOptions(Options):
    """The projector and the calibration of a rig."""

    projector: Annotated[Resolution, WidthHeight, Spelling(metavar="1280x800")]
    """Width and height of the projector in pixels."""
    calibration: Annotated[Path | None, Role.INPUT] = None
    """OpenCV file (.yml, .xml, .json) or that of SLStudio with the intrinsics of camera and projector and the pose of both; None: relit
    calibrate procam measures them."""
    unit_m: Positive = 1.0
    """Metres in one unit of the translation in `calibration`, such as 0.001 for millimetres."""


class ExposureOrder(Choice):
    """The order of the images of several exposures."""

    EXPOSURE = "exposure", "each pattern at all exposures, then the next pattern"
    PATTERN = "pattern", "all patterns at one exposure, then at the next"


class PatternImageOptions(Options):
    """The images of the folder that are frames of patterns."""

    images: Annotated[Line | None, Spelling(metavar="GLOB")] = None
    """Names of the frames, such as 'phase_*.png', taken in natural order; None: every image that is not named otherwise."""
    mask: Annotated[Line | None, Spelling(metavar="NAME")] = None
    """Image of the mask; None: the one with the word mask in its name, if there is one."""
    white: Annotated[Line | None, Spelling(metavar="NAME")] = None
    """Image under a white projection; None: the one with the word white in its name, if there is one."""
    black: Annotated[Line | None, Spelling(metavar="NAME")] = None
    """Image under a black projection; None: the one with the word black in its name, if there is one."""
    color_space: ColorSpaceName = "lin_rec709_scene"
    """Colour space of the images: those of most scanners are linear."""
    video_frames: Annotated[Line | None, Spelling(metavar="FIRST-LAST[:STEP]")] = None
    """Frames of the video that SRC is, counted from 0, such as 12-600:6 where each pattern was shown for six frames; None: all."""
    exposures_s: Annotated[tuple[Positive, ...] | None, Commas, Spelling(metavar="S,S,…")] = None
    """Exposure times in seconds at which every pattern was taken, in the order of the images; None: one, which is not needed."""
    exposure_order: ExposureOrder = ExposureOrder.EXPOSURE
    """The part that changes first from image to image where there are several exposures."""


class Inverses(Choice):
    """The place of the inverse images of a Gray code."""

    PAIRS = "pairs", "each image is followed by its inverse"
    FIRST = "first", "each image follows its inverse"
    BLOCKS = "blocks", "all images of an axis, then their inverses"
    NONE = "none", "there are none"


class GrayImport(PatternImageOptions, RigOptions, ImportRequest):
    """Images of a Gray code in any order."""

    sequence: Annotated[tuple[Line, ...], Commas, Spelling(metavar="PART,PART,…")] = ("columns", "rows", "white", "black")
    """The order of the parts in the images: columns, rows, white and black, each once or not at all."""
    inverses: Inverses = Inverses.PAIRS
    """The place of the inverse images."""
    fine_first: bool = False
    """The finest stripes come first; else the coarsest."""
    column_bits: Count | None = None
    """Number of images that code the columns, the finest left out where they are fewer; None: all bits of the projector."""
    row_bits: Count | None = None
    """Number of images that code the rows; None: all bits of the projector."""


class PhaseShift(Choice):
    """The direction in which the waves move from step to step."""

    MINUS = "minus", "cos(2πu/P − 2πi/N), to larger columns, as relit and SLStudio do"
    PLUS = "plus", "cos(2πu/P + 2πi/N)"


class WaveOrigin(Choice):
    """The place of column 0 of a wave in the projector."""

    EDGE = "edge", "at the outer edge of the first pixel, as relit has it"
    CENTRE = "centre", "at its centre, as in cos(2πx/P) with the number x of the pixel"


class PhaseImport(PatternImageOptions, RigOptions, ImportRequest):
    """Images of phase shifts in any order, with a Gray code that numbers the periods or without."""

    periods: Annotated[tuple[Positive, ...], Commas, Spelling(metavar="P,P,…")]
    """Periods in projector pixels, in the order of the images."""
    steps: Annotated[int, Field(ge=3)]
    """Number of images for each period."""
    axis: PatternAxis = PatternAxis.COLUMN
    """The projector coordinate that is coded; both: columns first."""
    row_periods: Annotated[tuple[Positive, ...] | None, Commas, Spelling(metavar="P,P,…")] = None
    """Periods along the rows; None: as `periods`."""
    order: Annotated[tuple[Line, ...], Commas, Spelling(metavar="WORD,WORD,WORD")] = ("axis", "period", "step")
    """The order in which axis, period and step change from image to image, slowest first."""
    shift: PhaseShift = PhaseShift.MINUS
    """Direction in which the waves move from step to step."""
    offset_deg: Finite = 0.0
    """Phase at `origin` in the first step, degrees. Waves that are sines have -90."""
    origin: WaveOrigin = WaveOrigin.EDGE
    """The place of column 0 of the waves."""
    gray_images: Annotated[Line | None, Spelling(metavar="GLOB")] = None
    """Names of the images of a Gray code that numbers the periods."""
    gray_stripe: Positive | None = None
    """Width of the finest stripe of the Gray code in projector pixels: a period or less; half a period or less without inverses."""
    gray_inverses: Inverses = Inverses.NONE
    """The place of the inverse images of the Gray code."""
    gray_fine_first: bool = False
    """The finest stripes of the Gray code come first."""

    @model_validator(mode="after")
    def _stripe_of_the_code(self) -> Self:
        if (self.gray_images is None) != (self.gray_stripe is None):
            raise ValueError("--gray-images and --gray-stripe belong together: give both, or none")
        return self


class Codec(Choice):
    """The patterns that a scanning program projects, and their order."""

    OPENCV_GRAY = "opencv-gray", "GrayCodePattern: columns and rows with inverses, white, black"
    SLSTUDIO_GRAY = "slstudio-gray", "white, black, ten bits of columns, six of rows"
    SLSTUDIO_PHASE_2X3 = "slstudio-phase-2x3", "three steps of 16 periods, three of one"
    SLSTUDIO_PHASE_3 = "slstudio-phase-3", "three steps of one period"
    SLSTUDIO_PHASE_4 = "slstudio-phase-4", "four steps of one period"
    SLSTUDIO_MICRO = "slstudio-micro", "three steps of one of ten short periods, one of each other"
    SLSTUDIO_MODULATED = "slstudio-modulated", "three steps of eight periods at three of a carrier, three of one period"


class ScannerImport(ImportRequest):
    """Images of a scanning program (SLStudio, or any in OpenCV's order) with its calibration file."""

    calibration: Annotated[Path, Role.INPUT]
    """Calibration of camera and projector: SLStudio's calibration.xml, or an OpenCV file (.yml, .xml, .json)."""
    codec: Codec
    """The patterns that were projected."""
    unit_m: Positive
    """Metres in one unit of the translation: SLStudio has millimetres, 0.001."""
    axis: PatternAxis = PatternAxis.COLUMN
    """The projector coordinate that is coded."""
    projector: Annotated[Resolution | None, WidthHeight, Spelling(metavar="1280x800")] = None
    """Width and height of the projector in pixels; None: as the calibration says."""
    images: Annotated[Line | None, Spelling(metavar="GLOB")] = None
    """Names of the frames, taken in natural order; None: every image but the mask."""


class StereoImport(EncodingOptions, ImportRequest):
    """Images of two cameras at the same moments, under projected texture or without, and the calibration of both."""

    source: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="LEFT")]
    """Folder of the images of the first camera, whose pixels get depths, or one image."""
    right: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="RIGHT")]
    """The same of the second camera; images belong together in natural order."""
    destination: Annotated[Path | None, Role.OUTPUT, Spelling(argument=True, metavar="DST")] = None
    """Folder for the capture, which gets links to the files; None: the folder that holds both."""
    calibration: Annotated[Path, Role.INPUT]
    """OpenCV file (.yml, .xml, .json) of stereoCalibrate with the first camera first: matrices, distortions, R and T."""
    extrinsics: Annotated[Path | None, Role.INPUT] = None
    """File of R and T where `calibration` lacks them, as OpenCV's sample writes them; None: they are in `calibration`."""
    unit_m: Positive = 1.0
    """Metres in one unit of T, such as 0.001 for millimetres."""


class InterleavedImport(EncodingOptions, ImportRequest):
    """Frames of a moving subject under lights that repeat a plan, a folder of images or a video, as a sequence: a capture each period."""

    period: Annotated[Line, Role.INPUT, Spelling(metavar="PLAN")]
    """The frames of one period: a plan.json (relit.plan/1), or names with commas between, such as dark,olat. A tracking frame that begins
    a period closes the one before."""
    rig: Annotated[Path | None, Role.INPUT, Spelling(metavar="RIG.json")] = None
    """The lamps (relit.rig/1), and the camera if the file has one; None: a projector alone gives light."""
    projector: Annotated[tuple[Side, Side] | None, WidthHeight, Spelling(metavar="WxH")] = None
    """Width and height of the projector in pixels, for patterns."""
    images: Annotated[Line | None, Spelling(metavar="GLOB")] = None
    """Names of the frames, such as 'take3_*.exr', taken in natural order; None: every image but the mask."""
    mask: Annotated[Line | None, Spelling(metavar="NAME")] = None
    """Image of the mask of all steps; None: the one with the word mask in its name, if there is one."""
    frames: Annotated[Line | None, Spelling(metavar="FIRST-LAST[:STEP]")] = None
    """Frames that are used, counted from 0, such as 12-600; None: all."""
    frame_rate: Positive | None = None
    """Frames of the camera a second; None: as a video says, else 24 periods a second."""
    saturation: Positive | None = None
    """The recorded value from which readings are clipped; None: full scale."""
