"""The file of a scan set, scan-set.json with schema relit.scan-set/1: range images and point sets of one object, with or without poses."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from stage.errors import ManifestError
from stage.files import write_text
from stage.folders import advice
from stage.model import Direction, Finite, FirstFault, NotNegative, Positive, Strict, Text, Vector
from stage.records import faults_of_each, read_record, record_text
from stage.transforms import ROTATION_ROUNDING, Row, off_rotation, rigid_fault, rotation_about

SCAN_SET_FILE = "scan-set.json"
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254}
"""The length of each unit that a point set may have, in metres."""
SYMMETRIC = 1e-6
"""The largest asymmetry of a covariance, and the largest negative eigenvalue, as a part of its largest number."""

MOST_M = 1e7
"""The largest coordinate, metres: beyond ten thousand kilometres single precision leaves nothing of a scan."""
Coordinate = Annotated[float, Field(ge=-MOST_M, le=MOST_M)]
MOST_OFF_ROTATION = 1e-3
"""The largest difference between R Rᵀ and the identity of a pose: poses of other programs, in single precision or multiplied many times,
are off by some 10⁻⁴; the nearest rotation is taken."""
Six = tuple[Finite, Finite, Finite, Finite, Finite, Finite]


def _covariance(rows: tuple[Six, ...]) -> tuple[Six, ...]:
    size = max(abs(value) for row in rows for value in row)
    if any(abs(rows[i][j] - rows[j][i]) > SYMMETRIC * size for i in range(6) for j in range(i)):
        raise ValueError("is not symmetric, as a covariance is")
    if any(rows[i][i] < 0 for i in range(6)):
        raise ValueError("has a variance below zero on its diagonal")
    return rows


def _rigid(rows: tuple[Row, Row, Row, Row]) -> tuple[Row, Row, Row, Row]:
    fault = rigid_fault(np.array(rows, dtype=np.float64), MOST_OFF_ROTATION)
    if fault:
        raise ValueError(fault)
    return rows


Pose = Annotated[tuple[Row, Row, Row, Row], AfterValidator(_rigid)]
"""The rows of a rotation and a translation; the rotation may be a little off one."""
Covariance = Annotated[tuple[Six, Six, Six, Six, Six, Six], AfterValidator(_covariance)]
"""The rows of the covariance of a pose: of a small rotation (x, y, z in radians, about the world's axes through the origin of the scan),
then of a translation (x, y, z in metres, world)."""


class TargetEntry(Strict):
    """A target that a scan shows: a sphere, a coded mark or a corner, measured by whatever means."""

    name: Text
    """The name of the target, the same in every scan that shows it."""
    position_m: Vector
    """Position of the target in the frame of the scan, metres."""
    sigma_m: Positive
    """Standard deviation of each coordinate, metres."""


class ScanEntry(Strict):
    """One scan: a range image or a set of points in the frame of the camera that took it."""

    name: Text
    """The name of the scan in reports, unlike the others."""
    path: Text
    """A result folder of `relit depth`, its depth.exr, or a PLY file, relative to the file."""
    unit: Literal["m", "cm", "mm", "um", "in"] = "m"
    """The unit of the coordinates of a PLY file; a depth.exr is in metres."""
    sigma_m: Positive | None = None
    """Standard deviation of every point along its line of sight, metres, where the scan does not hold it (a PLY file without the property
    sigma, a depth without sigma.Z). None: it is estimated by the scatter of the points around local planes."""
    viewpoint_m: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Position of the scanner for a PLY file, metres, in the frame of the scan: each point was seen from there, with nothing in the way.
    `relit fuse` needs it of PLY files. None: not known, and taken to be the origin where it only tells the side of a surface."""
    scan_to_world: Pose | None = None
    """The rows of world_from_scan: x_world = R x + t, in metres. None: `world_from_camera` of the depth result, or not known."""
    pose_covariance: Covariance | None = None
    """The covariance of `scan_to_world`. None: it is not known."""
    maps: Text | None = None
    """A result folder of `relit solve` for the same camera in the same place, or its maps.exr, relative to the file. None: none."""
    image: Text | None = None
    """A photograph by the camera of a range image from the same place, in which `relit register` looks for markers and boards, relative to
    the file. None: the colours of the points.ply beside the depth."""
    targets: Annotated[tuple[TargetEntry, ...], FirstFault] = ()
    """Named targets that the scan shows. Scans that show three of the same targets or more are placed by them as well as by their
    surfaces."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.pose_covariance is not None and self.scan_to_world is None:
            raise ValueError("pose_covariance: is given without scan_to_world")
        twice = next((target.name for number, target in enumerate(self.targets)
                      if target.name in {other.name for other in self.targets[:number]}), None)
        if twice is not None:
            raise ValueError(f"targets: {twice} is there twice: a scan shows a target once")
        return self


class Turntable(Strict):
    """A table that turned the object before a camera that stood still: the pose of scan i undoes a turn by `angles_deg[i]`."""

    axis_point_m: Vector
    """A point of the axis, metres, in the frame of the camera."""
    axis: Direction
    """The direction of the axis in the frame of the camera; turns count by the right-hand rule about it."""
    angles_deg: tuple[Finite, ...] | None = None
    """Turn of the table at each scan, degrees; one number a scan. The world is the camera frame at 0 degrees.
    None: the angles are not known."""
    angle_sigma_deg: NotNegative = 0.0
    """Standard deviation of each angle, degrees."""

    def pose_at(self, angle_deg: float) -> np.ndarray:
        """Return world_from_scan [4, 4] of a scan that was taken when the table had turned by an angle: it undoes the turn."""
        point = np.array(self.axis_point_m)
        pose = np.eye(4)
        pose[:3, :3] = rotation_about(self.axis, -angle_deg)
        pose[:3, 3] = point - pose[:3, :3] @ point
        return pose

    def angle_of(self, pose: np.ndarray) -> float:
        """Return the angle in degrees whose `pose_at` has the rotation nearest to that of a pose."""
        rotation, axis = pose[:3, :3], np.array(self.axis)
        vector = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
        return -float(np.degrees(np.arctan2(axis @ vector, np.trace(rotation) - axis @ rotation @ axis)))

    def freedom(self) -> np.ndarray:
        """Return the motion about the axis by one radian, of small ones: [6, 1] rotation vector, and translation at the world's origin."""
        axis = np.array(self.axis)
        return np.concatenate([axis, np.cross(self.axis_point_m, axis)])[:, None]


class ScanSet(Strict):
    """The content of scan-set.json."""

    schema_: Literal["relit.scan-set/1"] = Field(alias="schema")
    """The kind and version of the file."""
    name: Text
    """The name of the object."""
    scans: Annotated[tuple[ScanEntry, ...], Field(min_length=1), FirstFault]
    """The scans."""
    turntable: Turntable | None = None
    """The turntable that turned the object between the scans. None: there was none."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [scan.name for scan in self.scans]
        angles = None if self.turntable is None or self.turntable.angles_deg is None else len(self.turntable.angles_deg)
        fault = next(_between_scans(names, angles), None)
        if fault is not None:
            raise ValueError(fault)
        return self


def read_scan_set(path: Path) -> tuple[Path, ScanSet]:
    """Read and check a scan-set.json; `path`: the file, or the folder with it."""
    file = path / SCAN_SET_FILE if path.is_dir() else path
    if path.is_dir() and not file.exists():
        advised = advice(path, "`relit import scans` writes one for a folder of scans")
        raise ManifestError(f"{path}: holds no {SCAN_SET_FILE}: {advised}")
    return file, read_record(file, ScanSet, _faults)


def write_scan_set(scans: ScanSet, path: Path) -> None:
    """Write a scan-set.json whole or not at all, one scan a line, with what differs from its default."""
    write_text(path, record_text(scans, "scans"))


def rotation_warnings(scans: ScanSet) -> list[str]:
    """Return a sentence about the poses of a set whose rotations are off by more than rounding, which names the scans, or none."""
    off = {scan.name: off_rotation(np.array(scan.scan_to_world)) for scan in scans.scans if scan.scan_to_world is not None}
    named = [name for name, value in off.items() if value > ROTATION_ROUNDING]
    return [] if not named else [f"{', '.join(named)}: the rotation of scan_to_world is off orthonormal by up to "
                                 f"{max(off.values()):.1g}: the nearest rotation is taken"]


def _faults(data: dict[str, Any]) -> Iterator[str]:
    """Yield the faults of every scan of a file whose content is wrong, as sentences without the file."""
    scans = data.get("scans")
    if not isinstance(scans, list):
        return
    yield from faults_of_each(data, "scans", ScanEntry)
    turntable = data.get("turntable")
    angles = turntable.get("angles_deg") if isinstance(turntable, dict) else None
    yield from _between_scans([scan.get("name") if isinstance(scan, dict) else None for scan in scans],
                              len(angles) if isinstance(angles, list) else None)


def _between_scans(names: list[Any], angles: int | None) -> Iterator[str]:
    """Yield the faults that scans have together: a name of two scans, and another number of angles than of scans."""
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        if isinstance(name, str) and first.setdefault(name, index) != index:
            yield f"scans[{index}].name: {name} is already the name of scans[{first[name]}]"
    if angles is not None and angles != len(names):
        yield f"turntable.angles_deg: has {angles} entries for {len(names)} scans: give one for each"
