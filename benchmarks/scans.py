"""Registration of simulated scans of a figure of one metre, also against Open3D: the tables of docs/scans.md.

python -m benchmarks.scans [--rows 320] [--open3d PYTHON] [--trials 20] [--write docs/scans.md]

The figure of tests/scenes/turntable.py is ray-marched; each depth has independent noise of 0.25 mm. All scans count. PYTHON is an
interpreter that has open3d, which then registers the same scans: benchmarks/scans_open3d.py.
"""

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.file_mutations import write_between
from service.scans.points.rigid import about, applied, inverse, moved, step_between
from service.scans.points.scan import Scan
from service.scans.read import read_scan
from service.scans.registration.registration import Registration
from stage.results.depth_maps import DepthMaps
from stage.sets.scan_set import ScanEntry, ScanSet, Turntable
from tests.scenes.register import register
from tests.scenes.turntable import MM, View, figure, pose, see

CASES = {"18 scans, 20° apart": 18, "9 scans, 40° apart": 9, "6 scans, 60° apart": 6}
START, END = "<!-- made by benchmarks.scans -->", "<!-- end -->"


class Errors(NamedTuple):
    """How far poses are from the truth, after the best common motion of all."""

    shift_m: np.ndarray  # at the middle of the figure
    turn_degrees: np.ndarray


def scans_of(views: list[View]) -> list[Scan]:
    """Write and read the scans as depth results."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "scan-set.json"
        for number, view in enumerate(views):
            maps = DepthMaps(camera=view.camera, mask=view.mask, depth=view.depth, sigma=view.sigma)
            maps.write(file.parent / str(number) / "depth.exr")
        entries = tuple(ScanEntry(name=str(number), path=str(number)) for number in range(len(views)))
        scans = ScanSet(schema="relit.scan-set/1", name="figure", scans=entries)
        return [read_scan(file, scans, number) for number in range(len(views))]


def errors(views: list[View], poses: dict[int, np.ndarray]) -> Errors:
    """Return the errors of the poses, after the common motion that makes the sum of their squares least."""
    true = {number: views[number].world_from_scan for number in poses}
    common = next(iter(true)), np.zeros(6)
    motion = poses[common[0]] @ inverse(true[common[0]])
    for _ in range(5):
        steps = np.array([step_between(inverse(motion) @ poses[number] @ inverse(true[number]), np.zeros(3)) for number in poses])
        motion = motion @ moved(steps.mean(axis=0), np.zeros(3), np.eye(4))
    steps = np.array([step_between(inverse(motion) @ poses[number] @ inverse(true[number]), np.zeros(3)) for number in poses])
    return Errors(np.linalg.norm(steps[:, 3:], axis=1), np.degrees(np.linalg.norm(steps[:, :3], axis=1)))


def line(case: str, method: str, views: list[View], poses: dict[int, np.ndarray], seconds: float) -> str:
    """Return a row of the table."""
    if len(poses) < 2:
        return f"| {case} | {method} | {len(poses)} of {len(views)} | | | | | {seconds:.1f} s |"
    off = errors(views, poses)
    return (f"| {case} | {method} | {len(poses)} of {len(views)} | {np.sqrt((off.shift_m**2).mean()) / MM:.4f} mm | "
            f"{off.shift_m.max() / MM:.4f} mm | {np.sqrt((off.turn_degrees**2).mean()):.4f}° | {off.turn_degrees.max():.4f}° | "
            f"{seconds:.1f} s |")


def timed(scans: list[Scan], starts: list[np.ndarray | None], table: Turntable | None = None) -> tuple[Registration, float]:
    """Register, and return the seconds of all processors together, which the load of the machine hardly changes."""
    began = time.process_time()
    found = register(scans, starts, threads=os.cpu_count() or 1, table=table)
    return found, time.process_time() - began


def by_open3d(python: str, scans: list[Scan]) -> tuple[dict[int, np.ndarray], float]:
    """Register the same points with Open3D in another interpreter; the seconds are those of all processors, without reading."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "scans.npz"
        np.savez(file, **{f"{number:03d}": scan.points for number, scan in enumerate(scans)})
        done = subprocess.run([python, Path(__file__).with_name("scans_open3d.py"), file], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    return {int(number): np.array(rows) for number, rows in found["poses"].items()}, found["seconds"]


def table(rows: int, open3d: str | None) -> str:
    """Return the table in Markdown."""
    lines = ["| scans | method | joined | place, RMS | largest | turn, RMS | largest | processor time |",
             "|---|---|---|---|---|---|---|---|"]
    every = [see(figure, pose(20.0 * k), rows=rows, sigma=0.25 * MM, seed=k) for k in range(18)]
    read = scans_of(every)
    camera = inverse(pose(0.0))
    turntable = Turntable(axis_point_m=tuple(camera[:3, 3]), axis=tuple(camera[:3, :3] @ [0, 1, 0]))
    rng = np.random.default_rng(1)
    for case, count in CASES.items():
        views, scans = every[::18 // count], read[::18 // count]
        found, seconds = timed(scans, [None] * count)
        lines.append(line(case, "relit, nothing known", views, found.poses, seconds))
        if open3d is not None:
            lines.append(line(case, "Open3D, nothing known", views, *by_open3d(open3d, scans)))
        if count == 18:
            starts: list[np.ndarray | None] = [moved(rng.normal(scale=[0.02] * 3 + [0.008] * 3), np.zeros(3), view.world_from_scan)
                                               for view in views]
            found, seconds = timed(scans, starts)
            lines.append(line(case, "relit, starts 8 mm and 1° off", views, found.poses, seconds))
            starts = [turntable.pose_at(20.0 * k + rng.normal(scale=0.5)) for k in range(18)]
            found, seconds = timed(scans, starts, turntable)
            lines.append(line(case, "relit, axis known, angles 0.5° off", views, found.poses, seconds))
    return "\n".join(lines)


def trials(count: int, rows: int) -> str:
    """Return how large errors are in units of the σ that each pose has, over many draws of the noise."""
    lines = ["| scans | trials | place: error over σ, RMS | turn: error over σ, RMS | χ² of six numbers, mean | within its 95 % |",
             "|---|---|---|---|---|---|"]
    for angles in ((0.0, 20.0, 40.0), (0.0, 50.0), tuple(30.0 * k for k in range(12))):
        places, turns, squares = [], [], []
        for trial in range(count if len(angles) < 12 else max(count // 5, 2)):
            views = [see(figure, pose(angle), rows=rows, sigma=0.25 * MM, seed=1000 * trial + k) for k, angle in enumerate(angles)]
            starts: list[np.ndarray | None] = [view.world_from_scan for view in views]
            found = register(scans_of(views), starts, threads=os.cpu_count() or 1)
            for number, placed in found.poses.items():
                if number == found.reference:
                    continue
                covariance = found.covariances[number]
                off = step_between(placed @ inverse(views[number].world_from_scan), placed[:3, 3])
                squares.append(off @ np.linalg.solve(covariance, off))
                shift = about(applied(placed, np.array([[0, 0, -2.0]]))[0] - placed[:3, 3])
                middle, spread = shift @ off, shift @ covariance @ shift.T
                places.append(np.linalg.norm(middle[3:]) / np.sqrt(np.trace(spread[3:, 3:])))
                turns.append(np.linalg.norm(middle[:3]) / np.sqrt(np.trace(spread[:3, :3])))
        inside = float(np.mean(np.array(squares) < 12.592))  # χ² with 6 degrees of freedom
        lines.append(f"| {len(angles)}, {angles[1]:g}° apart | {len(squares) // (len(angles) - 1)} | "
                     f"{np.sqrt(np.mean(np.square(places))):.2f} | {np.sqrt(np.mean(np.square(turns))):.2f} | "
                     f"{np.mean(squares):.1f} | {inside:.0%} |")
    return "\n".join(lines)


def main() -> None:
    """Print the tables, or write them into the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=320, help="pixels of a scan; 320 are 4 mm on the figure")
    parser.add_argument("--open3d", help="a Python interpreter with open3d")
    parser.add_argument("--trials", type=int, default=0, help="draws of the noise for the table of covariances")
    parser.add_argument("--trial-rows", type=int, default=160, help="pixels of a scan in these trials")
    parser.add_argument("--write", type=Path, help="the document that the tables go into")
    arguments = parser.parse_args()
    made = table(arguments.rows, arguments.open3d)
    if arguments.trials:
        made += "\n\n" + trials(arguments.trials, arguments.trial_rows)
    write_between(arguments.write, START, END, made)


if __name__ == "__main__":
    main()
