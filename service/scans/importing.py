"""Import of scans as they come, as a scan set: a folder of PLY files, with the poses of a Stanford .conf file where there is one, or the
frames of a depth camera."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from service.requests.imports.scans import ScansImport
from service.scans.points.ply_points import read_ply_points
from service.scans.points.rigid import nearest_rigid
from service.scans.rgbd import DEPTH, depth_names, write_frames
from service.scans.viewpoints import find_viewpoints
from stage.errors import ManifestError, storage
from stage.importers.layout import Imported, natural_order, place_images, read_lines
from stage.sets.scan_set import SCAN_SET_FILE, UNITS_M, ScanEntry, ScanSet, write_scan_set


def import_scans(request: ScansImport) -> Imported:
    """Write a scan-set.json for the PLY files of a folder, and find out where the scanner stood; or for the frames of a depth camera.

    Raises:
        ManifestError: there are no scans, or the file of poses is wrong; names it.
        ResultError: a file is no PLY file, or holds no points.
        StorageError: a file cannot be read or written.
    """
    source, folder = request.source, request.folder
    with storage("read", source):
        names = natural_order(path.name for path in source.iterdir() if path.suffix.lower() == ".ply" and not path.name.startswith("."))
        tables = sorted(path for path in source.iterdir() if path.suffix.lower() == ".conf")
        images = depth_names(natural_order(path.name for path in source.iterdir()))
    path = folder / SCAN_SET_FILE
    if images and not names:
        if folder == source:
            raise ManifestError(f"{source}: depth images are converted: give another folder for the scans")
        frames, said = write_frames(request, images)
        write_scan_set(ScanSet(schema="relit.scan-set/1", name=source.resolve().name, scans=tuple(frames)), path)
        return Imported(path, tuple(said))
    if not names:
        raise ManifestError(f"{source}: holds neither PLY files nor images named *{DEPTH}")
    table = request.poses or (tables[0] if len(tables) == 1 else None)
    if table is not None:
        poses = _conf_poses(table)
        names = [name for name in names if name in poses] or names
    else:
        poses = {}
    unit = UNITS_M[request.unit.value]
    files = [read_ply_points(source / name) for name in names]
    points = [each.points * unit for each in files]
    placed = [poses.get(name) for name in names]
    for number, pose in enumerate(placed):
        if pose is not None:
            placed[number] = pose = pose.copy()
            pose[:3, 3] *= unit
    facts = [("scans", f"{len(names)} PLY files of {min(map(len, points))} to {max(map(len, points))} points"),
             ("size", f"{max(float(np.ptp(each, axis=0).max()) for each in points):.3g} m is the widest at --unit {request.unit}"),
             ("poses", "not known" if table is None else f"{sum(pose is not None for pose in placed)} from {table}")]
    if request.viewpoint_m is not None:
        places: list[tuple[float, ...] | None] = [request.viewpoint_m] * len(names)
        facts.append(("viewpoint", f"{','.join(f'{x:g}' for x in request.viewpoint_m)} m in the frame of each scan, as given"))
    else:
        found = find_viewpoints(points, [each.normals for each in files])
        if found.place is None:
            places = [None] * len(names)
            facts.append(("viewpoint", f"is missing: {found.reason}: give --viewpoint, or relit fuse cannot use the scans"))
        else:
            places = [tuple(float(f"{x:.4g}") for x in place) for place in found.place]
            facts.append(("viewpoint", f"estimated{f' to about {found.spread_degrees:.0f} degrees' if found.spread_degrees else ''}: "
                                       f"{found.reason}"))
    entries = tuple(ScanEntry.model_validate({
        "name": Path(name).stem, "path": name, "unit": request.unit.value, **({} if place is None else {"viewpoint_m": place}),
        **({} if pose is None else {"scan_to_world": pose.tolist()})}) for name, place, pose in zip(names, places, placed, strict=True))
    if folder != source:
        place_images(source, folder, names)
    write_scan_set(ScanSet(schema="relit.scan-set/1", name=source.resolve().name, scans=entries), path)
    return Imported(path, tuple(facts))


def _conf_poses(path: Path) -> dict[str, np.ndarray]:
    """Return world_from_scan [4, 4], in the unit of the file, of the meshes that a Stanford .conf file names.

    A line is `bmesh FILE tx ty tz qx qy qz qw`; the quaternions turn the world into the scan.

    Raises:
        ManifestError: a line is wrong.
    """
    poses = {}
    for number, line in read_lines(path):
        words = line.split()
        if words[0] not in ("bmesh", "mesh"):
            continue
        try:
            values = np.array([float(word) for word in words[2:9]])
        except ValueError:
            values = np.empty(0)
        if len(words) != 9 or not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1) > 0.01:
            raise ManifestError(f"{path}: line {number}: must be {words[0]} FILE tx ty tz qx qy qz qw, with a quaternion of length 1")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[3:]).as_matrix().T, values[:3]
        poses[words[1]] = nearest_rigid(pose)
    if not poses:
        raise ManifestError(f"{path}: names no scans in lines of bmesh")
    return poses
