"""Scans without poses to one surface, against Open3D's multiway registration and TSDF on the same scans: a table of docs/scans.md.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.many_views --open3d PYTHON [--rows 160] [--voxel-mm 4] [--write docs/scans.md]

The figure of tests/scenes/turntable.py is ray-marched from 18 places 20° apart; each depth has independent noise of 0.25 mm.
`relit register` and `relit fuse` are timed as whole commands, from the files of the scans to those of the mesh, but for the start of Python
and the compilation of kernels; Open3D from arrays in memory to the mesh in memory. Seconds are those of all processors together.
`relit` itself runs BLAS on one thread, because several that wait for each other double them; Open3D is left its threads.
"""

import argparse
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.file_mutations import write_between
from service.requests.register import FuseRequest, RegisterRequest
from service.scans.fusion.fuse import fuse
from service.scans.points.ply_points import read_ply_points
from service.scans.points.rigid import applied, inverse, moved, step_between
from service.scans.register import register_scans
from stage.results.depth_maps import DepthMaps
from stage.sets.scan_set import ScanEntry, ScanSet, read_scan_set, write_scan_set
from tests.scenes.turntable import MM, View, figure, pose, see

START, END = "<!-- made by benchmarks.many_views -->", "<!-- end of many_views -->"
HEAD = ("| | scans joined | registration | fusion | together | place, RMS | turn, RMS | vertices | surface: median | mean | RMS | 99 % |\n"
        "|---|---|---|---|---|---|---|---|---|---|---|---|")


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a call returns, and its seconds of all processors."""
    began = time.process_time()
    found = call()
    return found, time.process_time() - began


def write_scans(folder: Path, views: list[View], poses: list[np.ndarray | None]) -> Path:
    """Write scans as results of `relit depth`, and return the file of the set."""
    entries = []
    for number, (view, given) in enumerate(zip(views, poses, strict=True)):
        DepthMaps(camera=view.camera, mask=view.mask, depth=view.depth, sigma=view.sigma).write(folder / str(number) / "depth.exr")
        entries.append(ScanEntry(name=str(number), path=str(number), scan_to_world=None if given is None else given.tolist()))
    write_scan_set(ScanSet(schema="relit.scan-set/1", name="figure", scans=tuple(entries)), folder / "scan-set.json")
    return folder / "scan-set.json"


def off_surface(points: np.ndarray) -> np.ndarray:
    """Return how far points [n, 3] near the figure lie from its surface, metres: to first order, as its function is no exact distance."""
    step = 1e-5
    slope = np.stack([figure(points + step * axis) - figure(points - step * axis) for axis in np.eye(3)], axis=1) / (2 * step)
    return np.asarray(figure(points) / np.linalg.norm(slope, axis=1))


def row(name: str, views: list[View], poses: dict[int, np.ndarray], registration: float, fusion: float, points: np.ndarray) -> str:
    """Return a line of the table: errors after the common motion that makes those of the poses least."""
    true = {number: views[number].world_from_scan for number in poses}
    first = min(poses)
    motion, steps = poses[first] @ inverse(true[first]), np.zeros((0, 6))
    for _ in range(6):
        steps = np.array([step_between(inverse(motion) @ poses[k] @ inverse(true[k]), np.zeros(3)) for k in poses])
        motion = motion @ moved(steps.mean(axis=0), np.zeros(3), np.eye(4))
    error = 1e3 * off_surface(applied(inverse(motion), points.astype(np.float64)))
    place, turn = 1e3 * np.sqrt((steps[:, 3:] ** 2).sum(axis=1).mean()), np.degrees(np.sqrt((steps[:, :3] ** 2).sum(axis=1).mean()))
    return (f"| {name} | {len(poses)} of {len(views)} | {registration:.1f} s | {fusion:.1f} s | {registration + fusion:.1f} s | "
            f"{place:.3f} mm | {turn:.4f}° | {len(points)} | {np.median(np.abs(error)):.3f} mm | {error.mean():+.3f} mm | "
            f"{np.sqrt((error**2).mean()):.3f} mm | {np.percentile(np.abs(error), 99):.3f} mm |")


def by_relit(views: list[View], voxel_m: float, device: str) -> str:
    """Return the line of both commands."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        few = [see(figure, pose(20.0 * k), rows=64, sigma=0.25 * MM, seed=k) for k in range(2)]
        fuse(FuseRequest(scan_set=write_scans(folder / "few", few, [view.world_from_scan for view in few]), out=folder / "few-fused",
                         voxel_m=0.02, texture=False, device=device))  # compiles the kernels
        given = write_scans(folder / "scans", views, [None] * len(views))
        registered, registration = timed(lambda: register_scans(RegisterRequest(scan_set=given, out=folder / "registered")))
        found = read_scan_set(registered.scan_set_path)[1]
        poses = {number: np.array(scan.scan_to_world) for number, scan in enumerate(found.scans) if scan.scan_to_world is not None}
        write_scan_set(found.model_copy(update={"scans": tuple(found.scans[number] for number in poses)}), registered.scan_set_path)
        fused, fusion = timed(lambda: fuse(FuseRequest(scan_set=registered.scan_set_path, out=folder / "fused", voxel_m=voxel_m,
                                                       texture=False, device=device)))
        return row("relit", views, poses, registration, fusion, read_ply_points(fused.mesh_path).points)


def by_open3d(python: str, views: list[View], voxel_m: float) -> str:
    """Return the line of Open3D, which runs in another interpreter."""
    here = Path(__file__)
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    with tempfile.TemporaryDirectory() as name:
        scans, images, mesh = (Path(name) / f"{part}.npz" for part in ("scans", "images", "mesh"))
        arrays = {f"{number:03d}": view.camera.points(-view.depth)[view.mask].astype(np.float32) for number, view in enumerate(views)}
        np.savez(scans, **arrays)
        done = subprocess.run([python, here.with_name("scans_open3d.py"), scans], capture_output=True, text=True, check=True,
                              env=environment)
        found = json.loads(done.stdout.splitlines()[-1])
        poses = {int(number): np.array(rows) for number, rows in found["poses"].items()}
        np.savez(images, depth=np.stack([views[k].depth for k in poses]), pose=np.stack(list(poses.values())),
                 focal=np.full(len(poses), views[0].camera.image_coordinates(np.array([[1.0, 0.0, -1.0]]))[0][0]
                                                  - views[0].camera.principal_point[0]))
        done = subprocess.run([python, here.with_name("fusion_open3d.py"), images, mesh, str(voxel_m)], capture_output=True, text=True,
                              check=True, env=environment)
        return row("Open3D", views, poses, found["seconds"], json.loads(done.stdout.splitlines()[-1])["seconds"],
                   np.load(mesh)["points"])


def main() -> None:
    """Print the table, or write it into the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=160, help="pixels of a scan")
    parser.add_argument("--voxel-mm", type=float, default=4.0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--open3d", required=True, help="a Python interpreter with open3d")
    parser.add_argument("--write", type=Path, help="the document that the table goes into")
    given = parser.parse_args()
    views = [see(figure, pose(20.0 * k), rows=given.rows, sigma=0.25 * MM, seed=k) for k in range(18)]
    points = int(np.mean([np.count_nonzero(view.mask) for view in views]))
    made = "\n".join([
        f"18 scans of {given.rows * 3 // 4} × {given.rows} pixels, {points} points each; voxels of {given.voxel_mm:g} mm.\n", HEAD,
        by_relit(views, given.voxel_mm * MM, given.device), by_open3d(given.open3d, views, given.voxel_mm * MM)])
    write_between(given.write, START, END, made)


if __name__ == "__main__":
    main()
