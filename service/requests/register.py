"""What `relit register` takes."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import BeforeValidator, Field, model_validator

from service.requests.base import Choice, Options, Role, Spelling
from service.requests.calibrate import Corners, board_corners
from stage.model import Fraction, Line, Positive


class GivenPoses(Choice):
    """What the poses of the scan set are taken for."""

    REFINED = "refined", "starts, right to about a sixtieth of the object; pairs that do not overlap there are not tried"
    IGNORED = "ignored", "nothing: all pairs are searched"


class TableUse(Choice):
    """What the turntable of the scan set is taken for."""

    START = "start", "its angles give the starts of all poses, which then move freely"
    ANGLES = "angles", "the axis is right, and only the angles are found"
    FIXED = "fixed", "axis and angles are right: nothing is moved, and the report says what the surfaces say of it"


class Markers(Choice):
    """The set of coded markers that lie among the scanned."""

    ARUCO4, ARUCO5, ARUCO6, ARUCO7 = "aruco4", "aruco5", "aruco6", "aruco7"
    APRILTAG16H5, APRILTAG25H9, APRILTAG36H11 = "apriltag16h5", "apriltag25h9", "apriltag36h11"


class RegisterOptions(Options):
    """How scans are registered."""

    poses: GivenPoses = GivenPoses.REFINED
    """What the poses of the scan set are taken for."""
    turntable: TableUse = TableUse.START
    """What the turntable of the scan set is taken for, where it has one."""
    cell_m: Positive | None = None
    """Side of the cells whose points are averaged for the search without starts, metres. None: a sixtieth of the median extent of the
    scans."""
    least_overlap: Annotated[Fraction, Field(gt=0)] = 0.1
    """Least part of the smaller of two scans that must lie on the surface of the other."""
    reference: Line | None = None
    """Name of the scan whose pose stays. None: the first with a pose, or the first."""
    markers: Markers | None = None
    """Set of coded markers, printed and stuck around the object, that are looked for in the images of range images and used as targets.
    None: none are looked for."""
    board: Annotated[tuple[Corners, Corners] | None, BeforeValidator(board_corners), Spelling(metavar="9x6")] = None
    """Inner corners of a chessboard that stands beside the object, across and down, one number odd and one even; it is looked for in the
    images of range images and its corners are used as targets. None: none is looked for."""

    @model_validator(mode="after")
    def _board_has_ends(self) -> Self:
        if self.board is not None and sum(self.board) % 2 == 0:
            raise ValueError(f"board: {self.board[0]}x{self.board[1]} looks the same from both ends: of its inner corners, one number must "
                             "be odd and the other even")
        return self


class RegisterRequest(RegisterOptions):
    """Find the poses of scans of one object by their surfaces, and say how sure each is and which scans could not be joined."""

    scan_set: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCAN_SET")]
    """A folder with a scan-set.json, or the file: depth results and PLY files, with or without poses."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for scan-set.json with the poses, and report.json."""
    threads: Annotated[int | None, Field(ge=1), Role.MACHINE] = None
    """Scans that are read, and pairs that are registered, at one time. None: one for each core."""
    memory_gb: Annotated[Positive, Role.MACHINE] = 2.0
    """Memory for scans that are read again, thinned, for further pairs, GB; each thread has two scans beside."""
    cache: Annotated[Path | None, Role.MACHINE] = None
    """Folder for thinned scans and registered pairs, from which a run that was interrupted goes on; it may be deleted afterwards. None: a
    temporary folder."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.turntable is not TableUse.START and self.poses is GivenPoses.IGNORED:
            raise ValueError(f"poses is ignored, but turntable is {self.turntable}: give one of them")
        return self
