"""The options of `relit compare`."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from service.requests.base.base import Choice, Commas, DeviceRequest, Options, Role, Spelling
from stage.model import Finite, Fraction, NotNegative, Positive

Unit = Literal["m", "cm", "mm", "um", "in"]


class Alignment(Choice):
    """The way by which a scan comes to lie on its design."""

    SEARCH = "search", "the pose is searched, whatever it is"
    REFINE = "refine", "the scan lies on the design to about a fiftieth of its size, and is moved the rest of the way"
    NONE = "none", "the scan is in the frame of the design, and stays where it is"


class CompareOptions(Options):
    """Options for the comparison of a scan with its design."""

    align: Alignment = Alignment.SEARCH
    """The way by which the scan comes to lie on the design."""
    scan_unit: Unit = "m"
    """Unit of the coordinates of the scan."""
    design_unit: Unit = "mm"
    """Unit of the coordinates of the design."""
    tolerance_m: Annotated[tuple[Finite, Finite] | None, Commas, Spelling(metavar="LOW,HIGH")] = None
    """Smallest and largest deviation of the whole surface that is allowed, metres; outside of the design is positive. None: the whole
    surface is not judged."""
    sigma_m: Positive | None = None
    """Standard deviation of each point across the surface, metres. None: that of the file (property sigma of a PLY file), else the scatter
    of the points around local planes."""
    shared_sigma_m: NotNegative = 0.0
    """Standard deviation of errors that whole regions of the scan share, such as those of its calibration, metres: no mean makes them
    smaller."""
    smallest_fault_m: Positive | None = None
    """Side of the smallest fault that is looked for, metres: mean deviations of patches of half that side are judged, so that it fills one.
    None: eight times the distance of neighbouring points."""
    reach_m: Positive | None = None
    """Largest deviation that is looked for, metres: points that are farther from the design do not belong to it. None: a fiftieth of its
    size."""
    false_alarm: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    """Largest probability that any region is judged wrongly, one within its tolerance as outside or one outside as within."""
    least_seen: Fraction = 0.9
    """Least part of a region that the scan must show for it to pass."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.tolerance_m is not None and self.tolerance_m[0] >= self.tolerance_m[1]:
            raise ValueError(f"tolerance_m: is {self.tolerance_m[0]:g},{self.tolerance_m[1]:g}: give the smaller limit first")
        return self


class CompareRequest(CompareOptions, DeviceRequest):
    """Compare a scan with the design of the part: its deviations with their σ, and whether regions are within their tolerances."""

    scan: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCAN")]
    """The scan: a PLY, STL or OBJ file, or a folder of `relit fuse`."""
    design: Annotated[Path, Role.INPUT]
    """The surface that was wanted: an STL, OBJ or PLY file of triangles. Programs for design export STEP as STL."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for deviations.ply, regions.csv, comparison.png and report.json."""
    regions: Annotated[Path | None, Role.INPUT] = None
    """Regions of the design with their tolerances (JSON, schema relit.tolerances/1). None: there are none."""
