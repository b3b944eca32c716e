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
    poses: Annotated[Path | None, Role.INPUT, Spelling(metavar="FILE.conf")] = None
    """Poses of the scans, in the format of the Stanford 3D Scanning Repository; None: the only .conf file of SRC, if there is one."""
    every: Count = 1
    """Take the first of so many depth images."""
    depth_unit_m: Positive = 0.001
    """Metres in one unit of a depth image."""
