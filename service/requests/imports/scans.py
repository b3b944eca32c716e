"""The options of `relit import` for scans and depth images."""

from pathlib import Path
from typing import Annotated

from service.requests.base.base import Choice, Commas, Role, Spelling
from service.requests.imports.base import ImportRequest
from stage.model import Count, Finite, Positive


class ScanUnit(Choice):
    """The unit of coordinates."""

    M = "m"
    CM = "cm"
    MM = "mm"
    UM = "um"
    INCH = "in"


class ScansImport(ImportRequest):
    """Point files (PLY, PTX, PTS, PCD, XYZ, LAS, E57) of one object scanned from several places, whose scanner is found, or the frames of a
    depth camera, as a scan set."""

    unit: ScanUnit = ScanUnit.M
    """The unit of the coordinates."""
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
