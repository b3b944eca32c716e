"""The options of `relit inspect-board`, `inspect-paste`, `gauge-board` and `board-capability`."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from service.requests.base.base import Choice, Commas, DeviceRequest, Options, Role, Spelling
from service.requests.base.option_values import StencilThickness
from stage.model import Finite, Fraction, NotNegative, Positive, Text


class BoardForm(Choice):
    """The form of the board that is removed from the deviations before they are judged."""

    PLANE = "plane", "offset and tilt of the board"
    QUADRATIC = "quadratic", "offset, tilt, bow and twist of the board"
    SPLINE = "spline", "a bending surface, as stiff as stiffness_m says; it takes broad defects with it"


class InspectBoardOptions(Options):
    """Options for stitching tiles, and for the deviations that are defects."""

    pixel_m: Positive | None = None
    """Side of a pixel of the height map in metres, where no golden map or design gives it. None: the largest distance of neighbouring
    points of a tile."""
    placement_m: Positive | None = None
    """Standard deviation of the place of a board in its fixture along x and y, metres. None: 5 pixels."""
    remove: BoardForm = BoardForm.QUADRATIC
    """The form of the board that is removed from the deviations before they are judged."""
    stiffness_m: Positive | None = None
    """Distance of the knots of the spline that is removed, metres: waves of three such distances and more go, defects of half of one stay.
    None: a quarter of the longer side of the board."""
    tolerance_m: NotNegative = 0.0
    """Deviation in metres up to which a place is no defect; in a region of the design, the wider of its limits counts if it is larger."""
    smallest_defect_m: Positive | None = None
    """Side of the smallest defect that is looked for, metres. None: 3 pixels."""
    must_find_m: Positive | None = None
    """Height of a defect of the smallest size, metres, that must be found with a probability of 95 %: pixels where the uncertainty hides it
    count as not inspected. None: every measured pixel counts as inspected, and the report says what would be found."""
    false_alarm: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
    """Largest probability of any false alarm on a board without defects; the windows of the map, and the regions of a design, each
    have half."""
    least_inspected: Fraction | None = None
    """Least part that must be inspected for a board to pass: of the pixels of each region that does not say it, and of all nominal pixels;
    a missing pixel is inspected if no defect of the smallest size hides there. None: 0.9 where there are regions, else 1."""

    @model_validator(mode="after")
    def _stiff(self) -> Self:
        if self.stiffness_m is not None and self.remove is not BoardForm.SPLINE:
            raise ValueError(f"stiffness_m: is that of a spline, but remove is {self.remove}: give --remove spline with it")
        return self


class InspectBoardRequest(InspectBoardOptions, DeviceRequest):
    """Stitch the tiles of a board to one height map, compare it with a golden map or a design, and list what is wrong."""

    board: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="BOARD")]
    """A folder with a board.json, or the file: the tiles, each a depth result or a capture."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for board.exr, deviation.exr, findings.csv, inspection.png and report.json."""
    golden: Annotated[Path | None, Role.INPUT] = None
    """Result folder or board.exr of a good board. None: the design, or else only the height map is made."""
    regions: Annotated[Path | None, Role.INPUT] = None
    """Tolerance regions that are judged on the golden board (JSON, schema relit.board-regions/1). None: only the whole board is judged."""
    design: Annotated[Path | None, Role.INPUT] = None
    """Nominal height map and tolerance regions (JSON, schema relit.board-design/1)."""
    cache: Annotated[Path | None, Role.MACHINE] = None
    """Folder for the image stacks of captures; None: .relit in each capture's folder."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.golden is not None and self.design is not None:
            raise ValueError("golden and design are both given: give one of them")
        if self.regions is not None and self.golden is None:
            raise ValueError("regions are given without golden: they are judged on the height map of a good board; a design has its own")
        return self


class GaugeBoardRequest(Options):
    """Repeatability and reproducibility of inspections of the same boards (gauge R&R)."""

    study: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="STUDY")]
    """The study: which result of relit inspect-board is of which board and operator (JSON, schema relit.gauge-study/1)."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for gauge.csv and report.json."""


class BoardSide(Choice):
    """The side of a board that was printed and measured."""

    TOP = "top", "the layer as it is"
    BOTTOM = "bottom", "the layer mirrored, as the board lies turned over about its y axis"


class InspectPasteRequest(DeviceRequest):
    """Measure the solder paste on every pad of a board, and judge it by limits."""

    board: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="BOARD")]
    """A folder with a board.json, or the file: the tiles, each a depth result or a capture."""
    paste: Annotated[Path, Role.INPUT]
    """The paste layer (Gerber): the openings of the stencil."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for board.exr, pads.csv, inspection.png and report.json."""
    stencil_m: Annotated[Positive, StencilThickness]
    """Thickness of the stencil in metres."""
    side: BoardSide = BoardSide.TOP
    """The side of the board."""
    origin_m: Annotated[tuple[Finite, Finite], Commas, Spelling(metavar="X,Y")] = (0.0, 0.0)
    """Place in the layer, metres, that lies at the origin of the board frame."""
    centroids: Annotated[Path | None, Role.INPUT] = None
    """Centroid file (pick and place) that names the components, where the layer does not. None: pads are numbered."""
    marks: Annotated[Path | None, Role.INPUT] = None
    """Drill file (Excellon), or Gerber layer with fiducials, from which offsets count. None: from where most of the paste lies, so that an
    offset of the whole print is not seen."""
    limits: Annotated[Path | None, Role.INPUT] = None
    """Limits of the pads (JSON, schema relit.paste-limits/1). None: pads are measured and not judged."""
    limit_class: Text | None = None
    """Class of the limits. None: the only one of the file."""
    area_level: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """Height above which paste belongs to its area, as a part of the stencil's thickness."""
    bridge_level: Annotated[float, Field(gt=0, lt=1)] = 0.4
    """Height above which paste connects pads, as a part of the stencil's thickness."""
    pixel_m: Positive | None = None
    """Side of a pixel of the height map in metres. None: the largest distance of neighbouring points of a tile."""
    placement_m: Positive | None = None
    """Standard deviation of the place of the board in its fixture along x and y, metres. None: 5 pixels."""
    false_alarm: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
    """Largest probability that any pad of a board within the limits fails."""
    least_inspected: Fraction = 0.9
    """Least part of a pad and its surroundings that must be measured; below, the pad is not inspected."""
    cache: Annotated[Path | None, Role.MACHINE] = None
    """Folder for the image stacks of captures; None: .relit in each capture's folder."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.limit_class is not None and self.limits is None:
            raise ValueError("limit_class is given without limits: give the file of the limits with it")
        return self


class BoardCapabilityRequest(Options):
    """Capability of a print over several boards (Cp and Cpk of every pad), or of the heights of regions."""

    study: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="STUDY")]
    """The study: results of relit inspect-paste or inspect-board, and which board each is of (JSON, schema relit.gauge-study/1)."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for capability.csv and report.json."""
