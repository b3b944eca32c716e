"""Import of scans as they come, as a scan set: a folder of point files, with the poses of a Stanford .conf file where there is one, the
frames of a depth camera, or folders with results of relit depth."""

import os
from functools import partial
from pathlib import Path

import numpy as np

from service.requests.imports.scans import ScansImport, ScanUnit
from service.scans.depth_frames import write_frames
from service.scans.file_scans import FileScan, read_file_scans
from service.scans.points.rigid import nearest_rigid
from service.scans.viewpoints import find_viewpoints
from stage.errors import ManifestError, storage
from stage.folders import natural_order
from stage.formats.ply import write_ply
from stage.importers.depth_frames import DEPTH, frame_layout, pose_of
from stage.importers.guess import POINT_FILES, depth_results
from stage.importers.layout import Imported, place_images, read_lines
from stage.results.depth_maps import DEPTH_FILE
from stage.results.maps import MAPS_FILE
from stage.sets.scan_set import SCAN_SET_FILE, UNITS_M, ScanEntry, ScanSet, Turntable, write_scan_set
from stage.transforms import ROTATION_ROUNDING, off_rotation

LARGE_M, SMALL_M = 50.0, 0.001
"""A scan of a format that has no unit is asked about if it is larger or smaller, metres."""
METRIC = (".e57", ".ptx", ".las", ".laz")
"""Formats of scanners of buildings and land, which are in metres."""
USUAL_M = (0.01, 10.0)
"""The sizes that another unit would have to give it."""
MIXED, MIXED_UNSAID = 100.0, 12.0
"""Scans of one object that differ so many times in size may be in different units; the second is for formats without a unit, where inches
among millimetres differ 25 times, and what one scan saw of the object and another by up to two."""
FOR_POINTS = {"unit": "--unit", "viewpoint_m": "--viewpoint", "poses": "--poses"}
FOR_FRAMES = {"poses": "--poses", "intrinsics_px": "--intrinsics", "every": "--every", "depth_unit_m": "--depth-unit-m"}
"""The options that point files, and the frames of a depth camera, take beside those of a turntable; results of relit depth take none."""
COARSE = 1e-4
"""Steps between the numbers of a file, in sizes of the scan, that are said: finer ones are below the noise of scanners."""


def import_scans(request: ScansImport) -> Imported:
    """Write a scan-set.json for the point files of a folder, and find out where the scanner stood; for the frames of a depth camera; or
    for results of relit depth.

    Files other than PLY are written as PLY.
    Raises ManifestError: there are no scans, or the file of poses is wrong; names it. Raises ResultError: a file is not what its ending
    says, or holds no points. Raises StorageError: a file cannot be read or written."""
    source, folder = request.source, request.folder
    with storage("read", source):
        listed = natural_order(path.name for path in source.iterdir() if not path.name.startswith("."))
    names = [name for name in listed if name.lower().endswith(POINT_FILES)]
    metric = [name for name in names if name.lower().endswith(".e57")]
    if metric and request.unit not in (None, ScanUnit.M):
        raise ManifestError(f"{source / metric[0]}: E57 files are in metres: leave --unit {request.unit} out, and import other files apart")
    layout, tables = frame_layout(source), [source / name for name in listed if name.lower().endswith(".conf")]
    converted = [name for name in names if not name.lower().endswith(".ply")]
    if folder == source and (converted or (layout and not names)):
        raise ManifestError(f"{source}: {converted[0] if converted else 'depth images'} are converted: give another folder for the scans")
    if layout is not None and not names:
        _refuse_unused(request, "depth images", FOR_FRAMES)
        return _written(request, *write_frames(request, layout, partial(_angles, request)))
    if not names and (results := depth_results(source)):
        _refuse_unused(request, "results of relit depth", {})
        return _written(request, _result_entries(request, results), [("scans", f"{len(results)} results of relit depth")])
    if not names:
        raise ManifestError(f"{source}: holds neither point files ({', '.join(POINT_FILES)}) nor images named *{DEPTH}, nor frames of "
                            f"TUM or Redwood, nor folders with a {DEPTH_FILE}")
    _refuse_unused(request, "point files", FOR_POINTS)
    table = request.poses or (tables[0] if len(tables) == 1 else None)
    poses = {} if table is None else _conf_poses(table)
    scans, moved = read_file_scans(source, [name for name in names if name in poses] or names, poses,
                                   None if request.unit is None else UNITS_M[request.unit.value])
    if folder == source and any(scan.converted is not None for scan in scans):
        raise ManifestError(f"{source}: its points lie far from the origin, and are counted from among them: give another folder for the "
                            "scans")
    _angles(request, len(scans))
    for scan in scans:
        if scan.converted is not None:
            folder.mkdir(parents=True, exist_ok=True)
            write_ply(scan.converted, folder / scan.path)
    placed = sum(scan.pose is not None for scan in scans)
    counts, sizes = [len(scan.points) for scan in scans], [float(np.ptp(scan.points, axis=0).max()) for scan in scans]
    facts = [("scans", f"{len(scans)} of {min(counts)} to {max(counts)} points"),
             ("size", f"{max(sizes):.3g} m is the widest at --unit {_unit(request)}"),
             ("poses", "not known" if not placed else f"{placed} from {'their files' if table is None else table}")]
    if left_out := sum(scan.left_out for scan in scans):
        facts.append(("points", f"{left_out} at 0 0 0 are left out: devices write so where nothing came back"))
    if request.viewpoint_m is None and _in_one_frame(scans):
        scans = [scan._replace(viewpoint=None) for scan in scans]
        facts.append(("poses", "are all the identity, and the scans do not look seen from their origin: they are taken to lie in one "
                               "frame, seen from elsewhere; if each is in the frame of its scanner, give --viewpoint 0,0,0, and relit "
                               "register --poses ignored"))
    facts += _units_said(request, scans)
    if moved is not None:
        facts.append(("origin", f"is moved to {','.join(f'{x:.0f}' for x in moved)} of the files, from which the points lie far away"))
    facts += _doubts(request, scans, sizes, any(name.lower().endswith(METRIC) for name in names))
    places = _viewpoints(request, scans, facts)
    entries = [ScanEntry.model_validate({
        "name": scan.name, "path": scan.path, "unit": _unit(request).value if scan.converted is None else "m",
        **({} if place is None else {"viewpoint_m": place}),
        **({} if scan.pose is None else {"scan_to_world": nearest_rigid(scan.pose).tolist()})})
        for scan, place in zip(scans, places, strict=True)]
    if folder != source:
        place_images(source, folder, [scan.path for scan in scans if scan.converted is None])
    return _written(request, entries, facts)


def _unit(request: ScansImport) -> ScanUnit:
    """Return the unit of coordinates whose file does not say it."""
    return request.unit or ScanUnit.M


def _units_said(request: ScansImport, scans: list[FileScan]) -> list[tuple[str, str]]:
    """Return what is said about scans whose files say another unit than `_unit`."""
    said: dict[tuple[float, float, float], list[str]] = {}
    for scan in scans:
        if scan.units_m is not None and not np.allclose(scan.units_m, UNITS_M[_unit(request).value], rtol=1e-9, atol=0):
            said.setdefault(scan.units_m, []).append(scan.name)
    facts = []
    for (across, _, up), names in said.items():
        words = f"the unit of {', '.join(names)} is {across:.9g} m{f', of heights {up:.9g} m' if up != across else ''}, as the files say"
        facts.append(("unit", words) if request.unit is None else ("warning", f"{words}, and --unit {request.unit} is taken"))
    return facts


def _refuse_unused(request: ScansImport, what: str, taken: dict[str, str]) -> None:
    """Refuse options that are given and that what the source holds does not take."""
    if unused := [flag for name, flag in (FOR_POINTS | FOR_FRAMES).items()
                  if name not in taken and getattr(request, name) != ScansImport.model_fields[name].default]:
        raise ManifestError(f"{request.source}: holds {what}, which take no {' and no '.join(unused)}: leave it out")


def _angles(request: ScansImport, count: int) -> tuple[float, ...] | None:
    """Return the angles of a turntable at so many scans; None where they are not known."""
    angles = request.turntable
    if angles is not None and len(angles) == 1:
        return tuple(0.0 + number * angles[0] for number in range(count))
    if angles is not None and len(angles) != count:
        raise ManifestError(f"{request.source}: has {count} scans, and --turntable {len(angles)} angles: give one for each, or one number, "
                            "the step")
    return angles


def _written(request: ScansImport, entries: list[ScanEntry], facts: list[tuple[str, str]]) -> Imported:
    """Write the scan set with the turntable of the options."""
    path, table = request.folder / SCAN_SET_FILE, None
    if request.axis is not None and request.axis_point_m is not None:
        angles = _angles(request, len(entries))
        table = Turntable(axis_point_m=request.axis_point_m, axis=request.axis, angles_deg=angles)
        each = [f"{entry.name} {angle:g}" for entry, angle in zip(entries, angles or (), strict=angles is not None)]
        said = f"{', '.join(each)} degrees" if each else "its angles are not known"
        facts = [*facts, ("table", said)]
    write_scan_set(ScanSet(schema="relit.scan-set/1", name=request.source.resolve().name, scans=tuple(entries), turntable=table), path)
    return Imported(path, tuple(facts))


def _result_entries(request: ScansImport, names: list[str]) -> list[ScanEntry]:
    """Return scans of folders with a depth.exr, with the normals of the maps that a solve has written beside it."""
    def place(name: str) -> str:
        return Path(os.path.relpath(request.source / name, request.folder)).as_posix()

    return [ScanEntry.model_validate({"name": name, "path": place(name),
                                      **({"maps": place(name)} if (request.source / name / MAPS_FILE).is_file() else {})})
            for name in names]


def _in_one_frame(scans: list[FileScan]) -> bool:
    """Return whether all poses are the identity, which programs write too for scans that they have moved into one frame, and the scans
    look seen from elsewhere than their origin, where their files put the scanner."""
    if len(scans) < 2 or any(scan.viewpoint is None or scan.pose is None or (scan.pose != np.eye(4)).any() for scan in scans):
        return False
    found = find_viewpoints([scan.points for scan in scans], [scan.normals for scan in scans]).place
    return found is not None and bool(found.any())


def _doubts(request: ScansImport, scans: list[FileScan], sizes: list[float], metric: bool) -> list[tuple[str, str]]:
    """Return what is asked about the sizes of scans, metres, and said about places that floats do not hold and rotations that are none;
    `metric`: the format says the unit, or is one of large places."""
    said = []
    largest, smallest = int(np.argmax(sizes)), int(np.argmin(sizes))
    if sizes[largest] > (MIXED if metric else MIXED_UNSAID) * sizes[smallest]:
        said.append(("warning", f"{scans[largest].name} is {sizes[largest]:.3g} m large and {scans[smallest].name} "
                                f"{sizes[smallest]:.3g} m: are they in one unit? import those of another unit apart"))
    elif not metric and not SMALL_M < sizes[largest] < LARGE_M:
        others = " or ".join(f"{unit} ({size:.3g} m)" for unit, metres in UNITS_M.items()
                             if USUAL_M[0] <= (size := sizes[largest] * metres / UNITS_M[_unit(request).value]) <= USUAL_M[1])
        said.append(("warning", f"the largest scan is {sizes[largest]:.3g} m large: is its unit {_unit(request)}? "
                                f"give --unit{others and f', which may be {others}'}"))
    for scan in scans:
        if scan.step_m > COARSE * np.ptp(scan.points, axis=0).max():
            said.append(("warning", f"{scan.name} lies so far from the origin that floats of 32 bits hold its points to {scan.step_m:.2g} "
                                    "m only: export it with doubles, or with an origin near it"))
    off = max((off_rotation(scan.pose) for scan in scans if scan.pose is not None), default=0.0)
    if off > ROTATION_ROUNDING:
        said.append(("turned", f"rotations were off orthonormal by up to {off:.1g}: the nearest are taken"))
    return said


def _viewpoints(request: ScansImport, scans: list[FileScan], facts: list[tuple[str, str]]) -> list[tuple[float, ...] | None]:
    """Return where the scanner of each scan stood, metres in the frame of the scan, or None, and add what is said of it to the facts."""
    if request.viewpoint_m is not None:
        facts.append(("viewpoint", f"{','.join(f'{x:g}' for x in request.viewpoint_m)} m in the frame of each scan, as given"))
        return [request.viewpoint_m] * len(scans)
    said: list[np.ndarray | None] = [scan.viewpoint for scan in scans]
    if all(place is not None for place in said):
        facts.append(("viewpoint", "as the files say"))
    else:
        found = find_viewpoints([scan.points for scan in scans], [scan.normals for scan in scans])
        if found.place is None:
            facts.append(("viewpoint", f"is missing: {found.reason}: give --viewpoint, or relit fuse cannot use the scans"))
        else:
            said = [_rounded(place, scan.points) if scan.viewpoint is None else scan.viewpoint
                    for scan, place in zip(scans, found.place, strict=True)]
            facts.append(("viewpoint", f"estimated{f' to about {found.spread_degrees:.0f} degrees' if found.spread_degrees else ''}: "
                                       f"{found.reason}"))
    return [None if place is None else tuple(place.tolist()) for place in said]


def _rounded(place: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return an estimated place [3] to a ten-thousandth of the size of the points [n, 3], or better."""
    return np.asarray(np.round(place, int(np.ceil(-np.log10(1e-4 * np.ptp(points, axis=0).max())))))


def _conf_poses(path: Path) -> dict[str, np.ndarray]:
    """Return world_from_scan [4, 4] of the meshes that a Stanford .conf file names, in the unit of the file, stretched as its quaternions.

    A line is `bmesh FILE tx ty tz qx qy qz qw`; the quaternions turn the world into the scan.
    Raises ManifestError: a line is wrong."""
    poses = {}
    for number, line in read_lines(path):
        words = line.split()
        if words[0] not in ("bmesh", "mesh"):
            continue
        pose = pose_of(words[2:])
        if pose is None:
            raise ManifestError(f"{path}: line {number}: must be {words[0]} FILE tx ty tz qx qy qz qw, with a quaternion of length 1")
        pose[:3, :3] = pose[:3, :3].T
        poses[words[1]] = pose
    if not poses:
        raise ManifestError(f"{path}: names no scans in lines of bmesh")
    return poses
