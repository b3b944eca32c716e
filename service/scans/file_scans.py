"""Scans of point files, in metres and counted from an origin near their points, which is what floats of 32 bits hold."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.scans.points.ply_points import chosen, read_ply_points, returned
from service.scans.points.point_files import read_point_scans
from service.scans.points.rigid import nearest_rigid
from service.scans.viewpoints import LEAST_POINTS
from stage.errors import ResultError
from stage.formats.ply import PointCloud

FAR_AWAY = 100.0
"""Coordinates of more than so many times the size of a scan are counted from another origin."""
GREY = 128
"""The colour of points without one, of 255."""


class FileScan(NamedTuple):
    """A scan of a file, in metres."""

    name: str
    path: str
    points: np.ndarray  # [n, 3]
    normals: np.ndarray | None
    viewpoint: np.ndarray | None  # [3] as its file says it
    pose: np.ndarray | None  # [4, 4] world from scan
    converted: PointCloud | None = None
    """What is written to `path`; None: it is a file of the source."""
    units_m: tuple[float, float, float] | None = None
    """Metres in one unit of x, y and z as its file says; None: it does not."""
    step_m: float = 0.0
    """Metres between the floats of 32 bits that hold the farthest points; 0: they are held by finer numbers, or counted from among them."""
    left_out: int = 0
    """Points at 0 0 0, to which nothing came back."""


def read_file_scans(folder: Path, names: list[str], poses: dict[str, np.ndarray], unit_m: float | None
                    ) -> tuple[list[FileScan], np.ndarray | None]:
    """Return the scans of files, of which those of other files than PLY are to be written, and the place in the files that becomes the
    origin, or None.

    `poses`: world from scan [4, 4] of PLY files, by name. `unit_m`: metres in one unit of all files; None: what each file says, and
    metres where it does not.
    Coordinates on a map are too large for floats of 32 bits: a PLY file with doubles is written anew. Of scans with poses the points are
    counted from among them in the frame of the scan, where the scanner then does not stand, and the poses from among their places.

    Raises ResultError: a file is not what its ending says, or its points span no surface. Raises StorageError: it cannot be read."""
    unit, moved, stems = unit_m or 1.0, None, {Path(name).stem for name in names if name.lower().endswith(".ply")}
    found = []

    def shift_of(points: np.ndarray, pose: np.ndarray | None) -> np.ndarray:
        nonlocal moved
        middle = np.rint(points.mean(axis=0)) if np.abs(points).max() > FAR_AWAY * np.ptp(points, axis=0).max() else None
        if pose is not None:
            return np.zeros(3) if middle is None else middle
        moved = middle if moved is None else moved
        return np.zeros(3) if moved is None else moved

    for name in names:
        stem = Path(name).stem
        if name.lower().endswith(".ply"):
            read = read_ply_points(folder / name)
            cloud = chosen(read, returned(read.points))
            pose = poses.get(name)
            _check_points(folder / name, cloud.points)
            doubles = bool((cloud.points != cloud.points.astype(np.float32)).any())
            shift = shift_of(cloud.points, pose) if doubles else np.zeros(3)
            pose = None if pose is None else _in_metres(pose, shift, unit)
            points = (cloud.points - shift) * unit
            converted = None if not shift.any() else PointCloud(
                points.astype(np.float32), _grey(points) if cloud.colours is None else cloud.colours, cloud.normals,
                sigma=None if cloud.sigma is None else cloud.sigma * unit, confidence=cloud.confidence)
            found.append(FileScan(stem, name, points, cloud.normals, None, pose, converted,
                                  step_m=_step(cloud.points) * unit if converted is None else 0.0,
                                  left_out=len(read.points) - len(cloud.points)))
            continue
        parts = read_point_scans(folder / name)
        for number, whole in enumerate(parts, start=1):
            there = returned(whole.points)
            part = whole._replace(points=whole.points[there], colours=None if whole.colours is None else whole.colours[there],
                                  normals=None if whole.normals is None else whole.normals[there])
            _check_points(folder / name, part.points)
            in_unit = part.points if unit_m is not None or part.units_m is None else part.points * part.units_m
            shift = shift_of(in_unit, part.pose)
            points = (in_unit - shift) * unit
            unique = stem if len(parts) == 1 else f"{stem}-{number}"
            while unique in stems:
                unique += "-" + Path(name).suffix[1:].lower()
            stems.add(unique)
            pose = None if part.pose is None else _in_metres(part.pose, shift, unit)
            place = None if part.viewpoint is None or (pose is not None and shift.any()) else (part.viewpoint - shift) * unit
            colours = _grey(points) if part.colours is None else part.colours
            converted = PointCloud(points.astype(np.float32), colours, part.normals)
            found.append(FileScan(unique, f"{unique}.ply", points, part.normals, place, pose, converted, part.units_m,
                                  _step(part.points) * unit if _floats(part.points) else 0.0, len(there) - len(part.points)))
    places = np.array([scan.pose[:3, 3] for scan in found if scan.pose is not None]).reshape(-1, 3)
    if moved is None and len(places) and np.abs(places).max() > FAR_AWAY * max(
            np.ptp(places, axis=0).max(), *(np.ptp(scan.points, axis=0).max() for scan in found)):
        moved = np.rint(places.mean(axis=0) / unit)
    for scan in found:
        if scan.pose is not None and moved is not None:
            scan.pose[:3, 3] -= moved * unit
    return found, moved


def _step(points: np.ndarray) -> float:
    """Return the distance between floats of 32 bits at the farthest of points [n, 3], in their unit."""
    return float(np.spacing(np.float32(np.abs(points).max())))


def _floats(points: np.ndarray) -> bool:
    """Return whether points [n, 3] were floats of 32 bits, also if they were written with nine digits."""
    near = points.astype(np.float32)
    return bool((np.abs(points - near) <= 0.05 * np.spacing(np.abs(near))).all())


def _grey(points: np.ndarray) -> np.ndarray:
    return np.full(points.shape, GREY, np.uint8)


def _check_points(path: Path, points: np.ndarray) -> None:
    """Refuse points [n, 3] that span no surface."""
    different, rest = 0, points
    while len(rest) and different < LEAST_POINTS:
        different, rest = different + 1, rest[(rest != rest[0]).any(axis=1)]
    if different < LEAST_POINTS:
        raise ResultError(f"{path}: holds {different} different point{'s' * (different != 1)}: a surface has {LEAST_POINTS} or more")


def _in_metres(pose: np.ndarray, shift: np.ndarray, unit: float) -> np.ndarray:
    """Return a pose [4, 4], whose translation is in a unit of so many metres, of points that are counted from a place [3] in that unit."""
    found = pose.copy()
    found[:3, 3] = unit * (pose[:3, 3] + nearest_rigid(pose)[:3, :3] @ shift)
    return found
