"""The depth and the photometric normals of many views joined on a fused mesh, on shapes with sharp edges: the tables of docs/joining.md.

    python -m benchmarks.joining_views [--write docs/joining.md]

Eight range images of 120 x 160 pixels of 7.5 mm; normals have noise of 0.5° and, in each view about another axis, a
drift. All vertices count. Then parts in front of each other (tests/scenes/in_front.py), seen from seven places, 2.8 mm between pixels.
"""

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.file_mutations import write_between
from service.requests.register import FuseRequest
from service.scans.fusion.fuse import fuse
from service.scans.points.ply_points import read_ply_points
from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps
from tests.scenes import in_front
from tests.scenes.statue import Shot, distance, nearest_part, turntable, write_scans
from tests.service.scans.mesh_files import read_faces

START, END = "<!-- made by benchmarks.joining_views -->", "<!-- end of the views -->"
SCENES_START, SCENES_END = "<!-- parts in front of each other: made by benchmarks.joining_views -->", "<!-- end of the parts -->"
NORMAL_DEGREES, VOXEL = 0.5, 4e-3
FINE_VOXEL = 2e-3
"""Metres, of the scenes in which parts stand in front of each other."""
RESOLVED = 1.0
"""Degrees that the face between three exact vertices errs by at most where the mesh resolves the surface."""
STATUE = ((5e-4, 2.0), (1e-3, 0.0), (1e-3, 2.0), (1.5e-3, 2.0))
"""Metres of noise of the depth and degrees of drift of the normals, of the statue."""
NOISE = ((2.5e-4, 2.0), (5e-4, 0.0), (5e-4, 3.0), (1e-3, 3.0), (1.5e-3, 2.0))
"""Metres of noise of the depth and degrees of drift of the normals, of the scenes in which parts stand in front of each other."""
DEAD = 0.03
"""Part of the pixels of the chair without a depth, and of others without a normal."""
PARTS = ("head", "body", "foot", "blade", "left plate")


def maps_of(shot: Shot, seed: int, drift_degrees: float) -> SurfaceMaps:
    """Return normals with noise that are turned by the drift about an axis of their own."""
    rng, step = np.random.default_rng(seed), 1e-5
    camera = Camera(projection="perspective", resolution=shot.side[::-1], focal_px=(shot.focal, shot.focal))
    points = camera.points(-shot.true)[shot.mask] @ shot.world_from_camera[:3, :3].T + shot.world_from_camera[:3, 3]
    slope = np.stack([distance(points + step * axis) - distance(points - step * axis) for axis in np.eye(3)], axis=-1)
    own = slope / np.linalg.norm(slope, axis=-1, keepdims=True) @ shot.world_from_camera[:3, :3]
    axis = rng.standard_normal(3)
    own = own @ Rotation.from_rotvec(np.radians(drift_degrees) * axis / np.linalg.norm(axis)).as_matrix().T
    own += np.radians(NORMAL_DEGREES) * rng.standard_normal(own.shape)
    normal = np.zeros((*shot.side, 3), dtype=np.float32)
    normal[shot.mask] = own / np.linalg.norm(own, axis=1, keepdims=True)
    return SurfaceMaps(camera=camera, mask=shot.mask, normal=normal, sigma=np.full(shot.side, NORMAL_DEGREES, dtype=np.float32))


def parts_in_front() -> list[str]:
    """Return the table of the scenes in which parts stand in front of each other."""
    lines = ["| scene | noise of depth, drift of normals | error of the surface, RMS: depth alone | joined | faces that the mesh "
             "resolves | exact corners | photometric normals | faces: depth alone | joined | joined / photometric | "
             "all faces: exact corners | photometric normals | depth alone | joined | contradicted vertices |",
             "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"]
    for name, scene in in_front.SCENES.items():
        for sigma, drift in NOISE:
            shots = in_front.fan(scene, sigma=sigma)
            maps = [in_front.photometric(scene, shot, seed=number, noise_degrees=NORMAL_DEGREES, drift_degrees=drift)
                    for number, shot in enumerate(shots)]
            if name == "chair":
                shots, maps = in_front.with_dead_pixels(shots, maps, DEAD)
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary)
                request = FuseRequest(scan_set=write_scans(folder, shots, sigma=sigma, maps=maps), out=folder / "depth", voxel_m=FINE_VOXEL,
                                      texture=False, device="cpu", cache=folder / "cache")
                alone, joined = fuse(request), fuse(request.model_copy(update={"out": folder / "joined", "join_normals": True}))
                assert alone.mesh_path is not None and joined.mesh_path is not None
                before, after, faces = read_ply_points(alone.mesh_path), read_ply_points(joined.mesh_path), read_faces(alone.mesh_path)
            assert before.normals is not None
            error, left = scene(before.points), scene(after.points)
            tilts = _tilts(scene, before.points, after.points, before.normals, faces, FINE_VOXEL)
            resolved, every = tilts.resolved, tilts.every
            numbers = [_rms_and_median(values[resolved]) for values in (tilts.exact, tilts.given, tilts.before, tilts.after)]
            numbers.append(f"{_rms(tilts.after[resolved]) / _rms(tilts.given[resolved]):.2f}")
            numbers += [f"{_rms(values[every]):.2f}°" for values in (tilts.exact, tilts.given, tilts.before, tilts.after)]
            lines.append(f"| {name} | {1e3 * sigma:g} mm, {drift:g}° | {1e3 * np.sqrt(np.mean(error**2)):.3f} mm | "
                         f"{1e3 * np.sqrt(np.mean(left**2)):.3f} mm | {resolved.mean():.0%} | {' | '.join(numbers)} | "
                         f"{joined.facts['joined_normals']['contradicted_share']:.1%} |")
    return lines


class Tilts(NamedTuple):
    """By how many degrees faces err."""

    exact: np.ndarray  # [F], were their corners exact
    given: np.ndarray  # [F], photometric normal of their first corner
    before: np.ndarray  # [F], of the depth alone
    after: np.ndarray  # [F], joined
    resolved: np.ndarray  # [F] bool, faces that the mesh resolves
    every: np.ndarray  # [F] bool, faces with an area


def _tilts(scene: in_front.Field, before: np.ndarray, after: np.ndarray, normals: np.ndarray, faces: np.ndarray, voxel: float) -> Tilts:
    error = scene(before)
    exact = before - error[:, None] * in_front.unit(in_front.gradient(scene, before))

    def tilt(points: np.ndarray) -> np.ndarray:
        return _degrees(in_front.face_normals(points, faces), in_front.gradient(scene, points[faces].mean(axis=1)))

    given = _degrees(normals[faces[:, 0]].astype(np.float64), in_front.gradient(scene, before[faces[:, 0]]))
    every = in_front.face_normals(before, faces).any(axis=1)
    resolved = every & (tilt(exact) < RESOLVED) & (np.abs(error[faces]).max(axis=1) < voxel)
    return Tilts(tilt(exact), given, tilt(before), tilt(after), resolved, every)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _degrees(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(one - in_front.unit(other), axis=-1) / 2, 0, 1)))


def _rms_and_median(degrees: np.ndarray) -> str:
    return f"{_rms(degrees):.2f}° ({np.median(degrees):.2f}°)"


def main() -> None:
    """Print the tables, or write them into the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="the document that the tables go into")
    arguments = parser.parse_args()
    lines = [f"| noise of the depth | drift of the normals | surface | median, mm | RMS, mm | 99 %, mm | {', '.join(PARTS)}: RMS, mm | "
             "resolved faces | photometric normals | joined / photometric | contradicted vertices |",
             "|---|---|---|---|---|---|---|---|---|---|---|"]
    for sigma, drift in STATUE:
        shots = turntable(8, (160, 120), sigma=sigma)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            file = write_scans(folder, shots, sigma=sigma, maps=[maps_of(shot, number, drift) for number, shot in enumerate(shots)])
            request = FuseRequest(scan_set=file, out=folder / "depth", voxel_m=VOXEL, texture=False, device="cpu", cache=folder / "cache")
            alone, joined = fuse(request), fuse(request.model_copy(update={"out": folder / "joined", "join_normals": True}))
            assert alone.mesh_path is not None and joined.mesh_path is not None
            before, after, faces = read_ply_points(alone.mesh_path), read_ply_points(joined.mesh_path), read_faces(alone.mesh_path)
        assert before.normals is not None
        tilts = _tilts(distance, before.points, after.points, before.normals, faces, VOXEL)
        given = _rms(tilts.given[tilts.resolved])
        for label, points, found in (("depth alone", before.points, tilts.before), ("joined", after.points, tilts.after)):
            error, part = 1e3 * distance(points), nearest_part(points)
            parts = ", ".join(f"{_rms(error[part == each]):.2f}" for each in PARTS)
            stayed = joined.facts["joined_normals"]["contradicted_vertices"] if label == "joined" else ""
            over = _rms(found[tilts.resolved]) / given
            lines.append(f"| {1e3 * sigma:g} mm | {drift:g}° | {label} | {np.median(np.abs(error)):.3f} | {_rms(error):.3f} | "
                         f"{np.percentile(np.abs(error), 99):.2f} | {parts} | {_rms_and_median(found[tilts.resolved])} | {given:.2f}° | "
                         f"{over:.2f} | {stayed} |")
    scenes = parts_in_front()
    if arguments.write is None:
        print("\n".join([*lines, "", *scenes]))
    else:
        write_between(arguments.write, START, END, "\n".join(lines))
        write_between(arguments.write, SCENES_START, SCENES_END, "\n".join(scenes))


if __name__ == "__main__":
    main()
