"""`relit fuse` on a simulated turntable, measured against the closed form of the statue; all vertices count.

    python -m benchmarks.fusion --rows 480 --voxel-mm 1
    python -m benchmarks.fusion --rows 480 --voxel-mm 1 --depths shots.npz            # the same scans for fusion_open3d.py
    python -m benchmarks.fusion --rows 480 --voxel-mm 1 --other mesh.npz              # and its `points`, measured alike
    python -m benchmarks.fusion --rows 480 --voxel-mm 1 --points                      # scans as PLY files, rays in random directions
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from service.requests.register import FuseRequest
from service.scans.fusion.fuse import fuse
from service.scans.points.ply_points import read_ply_points
from tests.scenes.clouds import all_around, entry
from tests.scenes.statue import PARTS, SIGMA, distance, nearest_part, turntable, write_scans, write_set

PRINTED = ("head", "body", "foot", "blade", "left plate", "bracket")


def row(name: str, points: np.ndarray, sigma: np.ndarray | None) -> str:
    error = 1e3 * distance(points)
    ratio = "" if sigma is None else f"{np.median(np.abs(error) / (1e3 * sigma)) / 0.6745:.2f}"
    return (f"| {name} | {len(points)} | {np.median(np.abs(error)):.3f} | {np.mean(error):+.3f} | {np.sqrt(np.mean(error**2)):.3f} | "
            f"{np.percentile(np.abs(error), 99):.3f} | {np.abs(error).max():.2f} | {ratio} |")


def table(name: str, points: np.ndarray, sigma: np.ndarray | None = None) -> None:
    part = nearest_part(points)
    print(f"\n{name}\n| part | vertices | median, mm | mean, mm | RMS, mm | 99 %, mm | largest, mm | error in units of σ |")
    print("|---|---|---|---|---|---|---|---|")
    print(row("all", points, sigma))
    for each in PRINTED:
        here = part == each
        if here.any():
            print(row(each, points[here], None if sigma is None else sigma[here]))


def peak_gib() -> float:
    """Return the most memory that this process has held, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=320)
    parser.add_argument("--views", type=int, default=18)
    parser.add_argument("--voxel-mm", type=float, default=2.0)
    parser.add_argument("--device")
    parser.add_argument("--depths", type=Path, help="write the depth images, poses and focal lengths here")
    parser.add_argument("--other", type=Path, help="an .npz with the points of another program's mesh of the same scans")
    parser.add_argument("--points", action="store_true", help="sets of points in place of range images")
    given = parser.parse_args()
    assert set(PRINTED) <= set(PARTS)
    shots = turntable(given.views, (given.rows, given.rows * 3 // 4))
    print(f"{given.views} scans of {given.rows * 3 // 4} x {given.rows} pixels of {2e3 / shots[0].focal:.2f} mm, noise {1e3 * SIGMA} mm")
    if given.depths:
        np.savez(given.depths, depth=np.stack([shot.depth for shot in shots]).astype(np.float32),
                 pose=np.stack([shot.world_from_camera for shot in shots]), focal=np.array([shot.focal for shot in shots]))
    with tempfile.TemporaryDirectory() as folder:
        if given.points:
            clouds = all_around(given.views, given.rows * given.rows * 3 // 4)
            file = write_set(Path(folder), [entry(cloud, Path(folder), number) for number, cloud in enumerate(clouds)])
            print(f"as {sum(len(cloud.points) for cloud in clouds)} points, beside {sum(shot.mask.sum() for shot in shots)} pixels")
        else:
            file = write_scans(Path(folder), shots)
        before = peak_gib()
        start = time.perf_counter(), time.process_time()
        result = fuse(FuseRequest(scan_set=file, out=Path(folder) / "out", voxel_m=1e-3 * given.voxel_mm, texture=False,
                                  device=given.device))
        wall, cpu = time.perf_counter() - start[0], time.process_time() - start[1]
        peak = peak_gib()
        ply = read_ply_points(result.mesh_path)
    table(f"relit fuse: {wall:.1f} s, {cpu:.1f} s of processors, {sum(s['fused'] for s in result.facts['scans'])} scans fused, "
          f"{result.facts['blocks']} blocks in {result.facts['bricks']} bricks, {result.facts['faces']} faces, peak {peak:.2f} GiB "
          f"({before:.2f} GiB before)", ply.points, ply.sigma)
    if given.other:
        table(str(given.other), np.load(given.other)["points"])
    for warning in result.warnings:
        print(warning)


if __name__ == "__main__":
    main()
