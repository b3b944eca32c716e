"""Read the scans of a scan set: depth results with what lies beside them, and PLY files."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.scans.points.planes import local_planes, robust_scatter
from service.scans.points.ply_points import PlyPoints, chosen, read_ply_points, returned
from service.scans.points.rigid import nearest_rigid
from service.scans.points.scan import Scan, Target
from stage.capture.camera import Camera
from stage.errors import ManifestError, ResultError
from stage.formats import exr
from stage.formats.ply import POINTS_FILE, read_ply
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.results.maps import MAPS_FILE, SurfaceMaps
from stage.results.result_metadata import camera_and_provenance, result_file
from stage.sets.scan_set import MOST_M, UNITS_M, ScanEntry, ScanSet

FLOAT_STEP = 2.0**-22
"""A float32 resolves a coordinate to this part of it: no σ is smaller."""
ORTHOGRAPHIC_RANGE_M = 1e3
"""Distance of the position of an orthographic camera above its image, in extents of the scan."""


class _Sigma(NamedTuple):
    values: np.ndarray
    source: str


def read_scan(file: Path, scans: ScanSet, number: int) -> Scan:
    """Read one scan of a set.
    `number`: of the scan, from 0."""
    entry = scans.scans[number]
    where = f"{file}: scans[{number}] ({entry.name})"
    path = file.parent / entry.path
    covariance = None if entry.pose_covariance is None else np.array(entry.pose_covariance, dtype=np.float64)
    if path.is_file() and path.suffix.lower() == ".ply":
        return _point_set(path, entry, where, _pose(entry), covariance)
    if not (path / DEPTH_FILE).is_file() and not (path.is_file() and path.suffix.lower() == ".exr"):
        raise ManifestError(f"{where}: path: {path} is neither a folder with a {DEPTH_FILE} nor a PLY file")
    return _range_image(path / DEPTH_FILE if path.is_dir() else path, entry, where, file.parent, covariance)


def given_pose(file: Path, entry: ScanEntry) -> np.ndarray | None:
    """Return world_from_scan [4, 4] that the set or the camera of a range image says, without reading what was measured."""
    path = file.parent / entry.path
    depth = path / DEPTH_FILE if path.is_dir() else path
    if entry.scan_to_world is None and depth.suffix.lower() == ".exr" and depth.is_file():
        return _pose(entry, camera_and_provenance(exr.read_header(depth).metadata, depth, file_name=DEPTH_FILE)[0])
    return _pose(entry)


def _pose(entry: ScanEntry, camera: Camera | None = None) -> np.ndarray | None:
    matrix = entry.scan_to_world or (None if camera is None else camera.world_from_camera)
    return None if matrix is None else nearest_rigid(np.array(matrix, dtype=np.float64))


def targets_of(entry: ScanEntry) -> tuple[Target, ...]:
    """Return the targets of a scan in its frame."""
    return tuple(Target(target.name, np.array(target.position_m), target.sigma_m**2 * np.eye(3)) for target in entry.targets)


def _range_image(path: Path, entry: ScanEntry, where: str, home: Path, covariance: np.ndarray | None) -> Scan:
    if entry.unit != "m":
        raise ManifestError(f"{where}: unit: is {entry.unit}, but {path.name} is in metres: leave it out")
    if entry.viewpoint_m is not None:
        raise ManifestError(f"{where}: viewpoint_m: {path.name} has a camera, which says where it was seen from: leave it out")
    depth = DepthMaps.read(path)
    camera = depth.camera
    if camera.projection == "orthographic" and camera.pixel_size_m is None:
        raise ManifestError(f"{where}: camera.pixel_size_m of {path} is missing: scans are placed in metres")
    used = depth.mask & np.isfinite(depth.depth) & (depth.depth > 0 if camera.projection == "perspective" else True)
    if depth.sigma is not None:
        used &= np.isfinite(depth.sigma) & (depth.sigma > 0)
    if not used.any():
        raise ManifestError(f"{where}: no pixel of {path} has a depth" + ("" if depth.sigma is None else " with a σ"))
    pixels = np.flatnonzero(used)
    x, y = camera.plane_coordinates()
    points = camera.points(-depth.depth).reshape(-1, 3)[pixels]
    stretch = np.sqrt(1 + x**2 + y**2).reshape(-1)[pixels] if camera.projection == "perspective" else np.ones(len(pixels))
    origin = np.zeros(3) if camera.projection == "perspective" else points.mean(axis=0) + ORTHOGRAPHIC_RANGE_M * np.array(
        [0, 0, max(float(np.ptp(points, axis=0).max()), np.finfo(np.float32).tiny)])
    measured = None if depth.sigma is None else depth.sigma.reshape(-1)[pixels] * stretch
    sigma = _sigma(measured, entry, points, where)
    maps = None if entry.maps is None else result_file(home / entry.maps, MAPS_FILE, command="relit solve")
    if maps is not None:
        _check_maps(maps, where, used)
    return Scan(name=entry.name, path=path, points=points, sigma=sigma.values, sigma_source=sigma.source, normals=None,
                colours=_colours(path, depth.mask, used),
                confidence=None if depth.confidence is None else depth.confidence.reshape(-1)[pixels].astype(np.float32), origin=origin,
                camera=camera, pixels=pixels, pose=_pose(entry, camera), pose_covariance=covariance, maps=maps, targets=targets_of(entry))


def _check_maps(path: Path, where: str, used: np.ndarray) -> None:
    maps = SurfaceMaps.read(path, layers=("normal",))
    if maps.normal is None:
        raise ResultError(f"{path}: has no layer normal")
    if maps.mask.shape != used.shape:
        raise ManifestError(f"{where}: maps: {path} is {maps.mask.shape[1]}x{maps.mask.shape[0]} pixels, the depth "
                            f"{used.shape[1]}x{used.shape[0]}: both must be of one camera in one place")


def _colours(path: Path, mask: np.ndarray, used: np.ndarray) -> np.ndarray | None:
    """Return the colours of the used pixels from the points.ply beside a depth, which has one point for each pixel of its mask; or None."""
    file = path.parent / POINTS_FILE
    if path.name != DEPTH_FILE or not file.is_file():
        return None
    colours = read_ply(file).colours
    return colours[used[mask]] if len(colours) == mask.sum() else None  # a laser has points between pixels


def _point_set(path: Path, entry: ScanEntry, where: str, pose: np.ndarray | None, covariance: np.ndarray | None) -> Scan:
    if entry.maps is not None:
        raise ManifestError(f"{where}: maps: {path.name} is a set of points: solved maps belong to a range image")
    unit = UNITS_M[entry.unit]
    origin = np.zeros(3) if entry.viewpoint_m is None else np.array(entry.viewpoint_m, dtype=np.float64)
    ply = _kept(read_ply_points(path), None if entry.viewpoint_m is None else origin / unit)
    if len(ply.points) == 0:
        beside = "" if entry.viewpoint_m is None else " that is not at viewpoint_m"
        raise ManifestError(f"{where}: has no point with a σ above 0{beside}")
    if (farthest := float(np.abs(ply.points).max()) * unit) > MOST_M:
        raise ManifestError(f"{where}: path: {path.name} has a coordinate of {farthest:.3g} m, {MOST_M:.0e} m are the most: check its unit")
    points = (ply.points * unit).astype(np.float32)
    sigma = _sigma(None if ply.sigma is None else ply.sigma * unit, entry, points, where)
    normals = None
    if ply.normals is not None:
        length = np.linalg.norm(ply.normals, axis=1, keepdims=True)
        normals = np.where(length > 0, ply.normals / np.maximum(length, 1e-30), 0).astype(np.float32)
    return Scan(name=entry.name, path=path, points=points, sigma=sigma.values, sigma_source=sigma.source, normals=normals,
                colours=ply.colours, confidence=ply.confidence, origin=origin, camera=None, pixels=None, pose=pose,
                pose_covariance=covariance, maps=None, targets=targets_of(entry))


def _kept(ply: PlyPoints, viewpoint: np.ndarray | None) -> PlyPoints:
    """Return the points without those whose σ says that they are none, and those at the scanner [3] or several times at 0 0 0,
    which are its way to say the same."""
    there = np.ones(len(ply.points), dtype=bool) if ply.sigma is None else np.isfinite(ply.sigma) & (ply.sigma > 0)
    there &= returned(ply.points)
    if viewpoint is not None:
        there &= np.abs(ply.points - viewpoint).max(axis=1) > FLOAT_STEP * np.abs(viewpoint).max()
    return chosen(ply, there)


def _sigma(measured: np.ndarray | None, entry: ScanEntry, points: np.ndarray, where: str) -> _Sigma:
    """Return σ along the line of sight of each point."""
    least = FLOAT_STEP * float(np.abs(points).max())
    if measured is not None:
        return _Sigma(np.maximum(measured, least).astype(np.float32), "measured")
    if entry.sigma_m is not None:
        return _Sigma(np.full(len(points), max(entry.sigma_m, least), dtype=np.float32), "declared")
    scatter = robust_scatter(local_planes(points, origin=points.mean(axis=0)))
    if not np.isfinite(scatter):
        raise ManifestError(f"{where}: sigma_m: is missing, and {len(points)} points are too few or too far apart to estimate it")
    return _Sigma(np.full(len(points), max(scatter, least), dtype=np.float32), "estimated")
