"""The options of `relit import` for scans and depth images."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import model_validator

from service.requests.base.base import Choice, Commas, Role, Spelling
from service.requests.imports.base import ImportRequest
from stage.model import Count, Direction, Finite, Positive, Vector


class ScanUnit(Choice):
    """The unit of coordinates."""

    M = "m"
    CM = "cm"
    MM = "mm"
    UM = "um"
    INCH = "in"


class ScansImport(ImportRequest):
    """Point files (PLY, PTX, PTS, PCD, XYZ, LAS, E57) of one object scanned from several places, whose scanner is found, the frames of a
    depth camera, or folders with results of relit depth, as a scan set."""

    unit: ScanUnit | None = None
    """The unit of the coordinates; None: that which a LAS file says, else m."""
    viewpoint_m: Annotated[tuple[Finite, Finite, Finite] | None, Commas, Spelling(flag="--viewpoint", metavar="X,Y,Z")] = None
    """Where the scanner stood in the frame of every scan, metres; None: it is estimated."""
    poses: Annotated[Path | None, Role.INPUT, Spelling(metavar="FILE")] = None
    """Poses of the scans: a .conf file of the Stanford 3D Scanning Repository, of frames groundtruth.txt or a trajectory .log; None: that
    of SRC, if there is one."""
    intrinsics_px: Annotated[tuple[Positive, Positive, Finite, Finite] | None, Commas, Spelling(flag="--intrinsics", metavar="FX,FY,CX,CY")
                             ] = None
    """Focal lengths and middle of the depth camera, pixels, whose centres have whole numbers; None: those of SRC."""
    every: Count = 1
    """Take the first of so many depth images."""
    depth_unit_m: Positive | None = None
    """Metres in one unit of a depth image; None: 0.001, of TUM's 0.0002."""
    turntable: Annotated[tuple[Finite, ...] | None, Commas, Spelling(metavar="STEP|A,B,C")] = None
    """How far a turntable turned between two scans, degrees, or its angle at each; None: it is not known, or there was none."""
    axis: Annotated[Direction | None, Commas, Spelling(metavar="X,Y,Z")] = None
    """Direction of the turntable's axis in the frame of the scans, about which it turned by the right-hand rule; None: there was none."""
    axis_point_m: Annotated[Vector | None, Commas, Spelling(flag="--axis-point", metavar="X,Y,Z")] = None
    """A point of the turntable's axis in the frame of the scans, metres."""

    @model_validator(mode="after")
    def _check_table(self) -> Self:
        if (self.axis is None) != (self.axis_point_m is None) or (self.turntable is not None and self.axis is None):
            raise ValueError("turntable: has no whole axis: give axis and axis_point_m")
        return self
