"""A simulated site: hundreds of range images of a courtyard from afar and of its statues from near, registered and fused out of core.

Usage: python -m benchmarks.site [--scans 200] [--megapixels 0.05] [--work DIR] [--write docs/scans.md]

The courtyard (24 m × 16 m) is walls, columns, blocks and statues of balls in closed form, so that every ray and every distance is exact.
Three of five scans are seen from afar (85° across, σ of 0.5 mm and 0.1 ‰ of the depth), the others from 1.3 m before a statue (45°, σ of
0.1 mm); one in ten is a PLY cloud in millimetres, which is registered and not fused. Poses start 20 mm and 0.2° off from afar, and 4 mm and
0.2° from near. `relit register` and `relit fuse --tiles` run as processes of their own, of which the memory and the time are told.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.camera import Camera
from stage.depth_maps import DepthMaps
from stage.ply import PointCloud, write_ply
from stage.scans.ply_points import read_ply_points
from stage.scans.records import ScanEntry, ScanSet, read_scan_set, write_scan_set
from stage.scans.rigid import exponential, rigid_between

LENGTH, WIDTH, HEIGHT = 24.0, 16.0, 7.0
STATUES = 10
FAR_SHARE, CLOUD_EVERY = 0.6, 10
FAR_OFF, NEAR_OFF, TURN_OFF = 0.02, 0.004, np.radians(0.2)
MOST_CHECKED = 100_000
"""Vertices whose distance from the true surface is computed, of all in equal steps."""
MARK, END = "<!-- made by benchmarks.site -->", "<!-- end of the site -->"


class Scene(NamedTuple):
    """Bodies in a box that is open above; y is up, the floor is y = 0."""

    balls: np.ndarray  # [n, 4] centre and radius
    columns: np.ndarray  # [n, 3] x, z, radius; from the floor to the top
    blocks: np.ndarray  # [n, 6] lowest and highest corner
    statues: np.ndarray  # [STATUES, 3] middle


def make_scene() -> Scene:
    rng = np.random.default_rng(18)
    balls, blocks, statues = [], [], []
    for number in range(STATUES):
        x = (number % 5 - 2) * 4.0 + rng.uniform(-0.5, 0.5)
        z = (3.2 if number < 5 else -3.2) + rng.uniform(-0.5, 0.5)
        half = rng.uniform(0.35, 0.5, 2)
        top = rng.uniform(0.7, 1.0)
        blocks.append([x - half[0], 0, z - half[1], x + half[0], top, z + half[1]])
        statues.append([x, top + 0.45, z])
        for _ in range(26):
            radius = rng.uniform(0.04, 0.2)
            spread = rng.normal(scale=[0.16, 0.28, 0.16])
            balls.append([x + spread[0], top + 0.4 + spread[1], z + spread[2], radius])
    for _ in range(220):  # bosses on the walls and on the floor
        wall, radius = rng.integers(5), rng.uniform(0.1, 0.5)
        place = rng.uniform([-LENGTH / 2, 0.3, -WIDTH / 2], [LENGTH / 2, HEIGHT - 1, WIDTH / 2])
        axis, side = [(0, -LENGTH / 2), (0, LENGTH / 2), (2, -WIDTH / 2), (2, WIDTH / 2), (1, 0.0)][wall]
        place[axis] = side - np.sign(side) * radius * rng.uniform(-0.4, 0.4) if axis != 1 else -radius * rng.uniform(0.2, 0.7)
        balls.append([*place, radius])
    for _ in range(18):
        middle, half = rng.uniform([-11, 0, -7.5], [11, 0, 7.5]), rng.uniform([0.1, 0.1, 0.1], [0.6, 0.5, 0.6])
        blocks.append([*(middle - half * [1, 0, 1]), *(middle + half * [1, 2, 1])])
    columns = [[x, z, rng.uniform(0.2, 0.35)] for z in (-6.0, 6.0) for x in rng.uniform(-0.4, 0.4, 7) + np.linspace(-10, 10, 7)]
    return Scene(np.array(balls), np.array(columns), np.array(blocks), np.array(statues))


def distance(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Distance of points [n, 3] from the nearest surface, metres."""
    x, y, z = points.T
    best = np.minimum.reduce([np.abs(y), np.abs(LENGTH / 2 - np.abs(x)), np.abs(WIDTH / 2 - np.abs(z))])
    for ball in scene.balls:
        best = np.minimum(best, np.abs(np.linalg.norm(points - ball[:3], axis=1) - ball[3]))
    for cx, cz, radius in scene.columns:
        best = np.minimum(best, np.abs(np.hypot(x - cx, z - cz) - radius))
    for block in scene.blocks:
        q = np.abs(points - (block[:3] + block[3:]) / 2) - (block[3:] - block[:3]) / 2
        best = np.minimum(best, np.abs(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)))
    return best


def look(scene: Scene, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Z-depth of each pixel, [rows, cols] float64 metres; 0 where the ray leaves by the top."""
    x, y = camera.plane_coordinates()
    ray = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ pose[:3, :3].T  # of unit depth
    eye = pose[:3, 3]
    depth = np.full(len(ray), np.inf)

    def nearer(index: np.ndarray | slice, found: np.ndarray) -> None:
        depth[index] = np.where((found > 1e-6) & (found < depth[index]), found, depth[index])

    with np.errstate(divide="ignore", invalid="ignore"):
        nearer(slice(None), (0 - eye[1]) / ray[:, 1])
        for axis, half in ((0, LENGTH / 2), (2, WIDTH / 2)):
            for side in (-half, half):
                at = (side - eye[axis]) / ray[:, axis]
                nearer(slice(None), np.where(eye[1] + at * ray[:, 1] < HEIGHT, at, np.inf))
    square = (ray**2).sum(axis=1)
    for ball in scene.balls:
        away = ball[:3] - eye
        along = ray @ away
        index = np.flatnonzero((along > 0) & (along**2 >= square * (away @ away - ball[3] ** 2)))
        root = np.sqrt(np.maximum(along[index] ** 2 - square[index] * (away @ away - ball[3] ** 2), 0))
        nearer(index, (along[index] - root) / square[index])
    flat = ray[:, 0] ** 2 + ray[:, 2] ** 2
    for cx, cz, radius in scene.columns:
        away = np.array([cx - eye[0], cz - eye[2]])
        along = ray[:, 0] * away[0] + ray[:, 2] * away[1]
        index = np.flatnonzero((along > 0) & (along**2 >= flat * (away @ away - radius**2)))
        root = np.sqrt(np.maximum(along[index] ** 2 - flat[index] * (away @ away - radius**2), 0))
        at = (along[index] - root) / flat[index]
        nearer(index, np.where(eye[1] + at * ray[index, 1] < HEIGHT, at, np.inf))
    with np.errstate(divide="ignore", invalid="ignore"):
        for block in scene.blocks:
            low, high = (block[:3] - eye) / ray, (block[3:] - eye) / ray
            first, last = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
            index = np.flatnonzero((first > 0) & (first <= last))
            nearer(index, first[index])
    return np.where(np.isfinite(depth), depth, 0).reshape(x.shape)


def looking(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """world_from_camera of a camera that looks at a point."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(back, right), back, eye
    return pose


class Truth(NamedTuple):
    pose: np.ndarray  # [4, 4]
    middle: np.ndarray  # [3] of its points, world
    size: float  # metres, RMS distance of its points from there
    far: bool


def write_site(scene: Scene, folder: Path, count: int, pixels: float) -> tuple[dict[str, Truth], int]:
    """Write scans one by one, and return the truth of each by its name, and the number of points."""
    rng = np.random.default_rng(1)
    cols = round(np.sqrt(pixels * 1.25))
    rows = round(cols / 1.25)
    entries, truth, points = [], {}, 0
    far_count = round(FAR_SHARE * count)
    for number in range(count):
        far = number < far_count
        if far:
            turn = 2 * np.pi * 0.381966 * number
            eye = np.array([rng.uniform(-8.5, 8.5), rng.uniform(1.5, 2.5), rng.uniform(-1.5, 1.5)])
            pose = looking(eye, eye + np.array([np.cos(turn), rng.uniform(-0.2, 0.0), np.sin(turn)]))
        else:
            statue = scene.statues[number % STATUES]
            turn = 2 * np.pi * (number // STATUES) / max((count - far_count) / STATUES, 1) + 0.3 * (number % STATUES)
            pose = looking(statue + 1.3 * np.array([np.cos(turn), rng.uniform(-0.1, 0.4), np.sin(turn)]), statue)
        focal = cols / 2 / np.tan(np.radians(85 if far else 45) / 2)
        camera = Camera(projection="perspective", resolution=(cols, rows), focal_px=(focal, focal))
        depth = look(scene, camera, pose)
        mask = depth > 0
        sigma = np.where(mask, 5e-4 + 1e-4 * depth if far else 1e-4, 0).astype(np.float32)
        noisy = np.where(mask, depth + sigma * rng.standard_normal(depth.shape), 0).astype(np.float32)
        name = f"{'far' if far else 'near'}{number:03d}"
        own = camera.points(-noisy)[mask]
        world = own.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        middle = world.mean(axis=0)
        truth[name] = Truth(pose, middle, float(np.sqrt(((world - middle) ** 2).sum(axis=1).mean())), far)
        points += len(own)
        start = pose.copy()
        start[:3, :3] = exponential(rng.normal(scale=TURN_OFF, size=3)) @ pose[:3, :3]
        start[:3, 3] = pose[:3, 3] + rng.normal(scale=FAR_OFF if far else NEAR_OFF, size=3)
        more = {}
        if number % CLOUD_EVERY == CLOUD_EVERY - 1:
            write_ply(PointCloud((1000 * own).astype(np.float32), np.zeros((len(own), 3), dtype=np.uint8)), folder / f"{name}.ply")
            more = {"unit": "mm", "sigma_m": float(np.median(sigma[mask]))}
        else:
            DepthMaps(camera=camera, mask=mask, depth=noisy, sigma=sigma).write(folder / name / "depth.exr")
        entries.append(ScanEntry(name=name, path=f"{name}.ply" if more else name, **more,
                                 scan_to_world=tuple(tuple(map(float, row)) for row in start)))
    write_scan_set(ScanSet(schema="relit.scan-set/1", name="site", scans=tuple(entries)), folder / "scan-set.json")
    return truth, points


class Cost(NamedTuple):
    wall_s: float
    processor_s: float
    peak_bytes: int


def run(*command: object) -> Cost:
    """Run a relit command, and return what it took."""
    began = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "service.cli.main", *map(str, command)], stdout=sys.stderr)
    _, status, usage = os.wait4(process.pid, 0)
    if (code := os.waitstatus_to_exitcode(status)) not in (0, 1):
        raise SystemExit(f"relit {command[0]} ended with {code}")
    return Cost(time.perf_counter() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024)


def pose_errors(registered: Path, truth: dict[str, Truth]) -> dict[str, tuple[float, float]]:
    """By how much each pose is wrong, after the best common motion of all: metres at the middle of its points, and degrees."""
    found = {entry.name: np.array(entry.scan_to_world) for entry in read_scan_set(registered)[1].scans if entry.scan_to_world is not None}
    true = np.concatenate([truth[name].middle + truth[name].size * np.concatenate([np.eye(3), -np.eye(3)]) for name in found])
    placed = np.concatenate([(truth[name].middle + truth[name].size * np.concatenate([np.eye(3), -np.eye(3)]) - truth[name].pose[:3, 3])
                             @ truth[name].pose[:3, :3] @ pose[:3, :3].T + pose[:3, 3] for name, pose in found.items()])
    common = rigid_between(placed[None], true[None], np.ones((1, len(true))))[0]
    out = {}
    for name, pose in found.items():
        motion = common @ pose @ np.linalg.inv(truth[name].pose)
        cosine = np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1)
        out[name] = (float(np.linalg.norm(motion[:3, :3] @ truth[name].middle + motion[:3, 3] - truth[name].middle)),
                     float(np.degrees(np.arccos(cosine))))
    return out


def surface_errors(scene: Scene, tiles: Path, motion: np.ndarray) -> np.ndarray:
    """Distances of vertices of all tiles from the true surface, metres, after a motion [4, 4]."""
    files = sorted(tiles.glob("*.ply"))
    total = sum(len(read_ply_points(path).points) for path in files)
    step = max(1, total // MOST_CHECKED)
    found = [distance(scene, read_ply_points(path).points[::step] @ motion[:3, :3].T + motion[:3, 3]) for path in files]
    return np.concatenate(found)


def common_motion(registered: Path, truth: dict[str, Truth]) -> np.ndarray:
    """[4, 4] true world from the world of the found poses."""
    found = [(truth[entry.name], np.array(entry.scan_to_world)) for entry in read_scan_set(registered)[1].scans if entry.scan_to_world]
    true = np.stack([each.middle for each, _ in found])
    placed = np.stack([pose[:3, :3] @ (each.pose[:3, :3].T @ (each.middle - each.pose[:3, 3])) + pose[:3, 3] for each, pose in found])
    return np.asarray(rigid_between(placed[None], true[None], np.ones((1, len(true))))[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--megapixels", type=float, default=0.05, help="of each scan; 5 makes 10⁹ points of 200 scans")
    parser.add_argument("--voxel-mm", type=float, help="default: half the median pixel of the scans from afar")
    parser.add_argument("--work", type=Path, default=Path("site-work"), help="folder for the scans and results, which is deleted")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--write", type=Path, help="page whose table gets a row")
    given = parser.parse_args()
    scene, work = make_scene(), given.work
    shutil.rmtree(work, ignore_errors=True)
    began = time.perf_counter()
    truth, points = write_site(scene, work / "scans", given.scans, 1e6 * given.megapixels)
    print(f"{given.scans} scans, {points:.3g} points, written in {time.perf_counter() - began:.0f} s; load "
          f"{os.getloadavg()[0]:.0f} on {os.cpu_count()} cores", flush=True)
    registering = run("register", work / "scans", "--out", work / "registered", "--threads", given.threads)
    errors = pose_errors(work / "registered", truth)
    report = json.loads((work / "registered" / "report.json").read_text())
    far = np.array([errors[name] for name in errors if truth[name].far])
    near = np.array([errors[name] for name in errors if not truth[name].far])
    for words, values in (("far", far), ("near", near)):
        print(f"{words}: {len(values)} joined; place median {1e3 * np.median(values[:, 0]):.3g} mm, largest "
              f"{1e3 * values[:, 0].max():.3g} mm; turn largest {values[:, 1].max():.3g}°", flush=True)
    print(f"pairs {len(report['pairs'])}, not tried {report['pairs_not_tried']}; {registering}", flush=True)
    file, listed = read_scan_set(work / "registered")
    images = [entry for entry in listed.scans if entry.scan_to_world is not None and not entry.path.endswith(".ply")]
    (work / "images").mkdir()
    write_scan_set(listed.model_copy(update={"scans": tuple(entry.model_copy(update={"path": str((file.parent / entry.path).resolve())})
                                                            for entry in images)}), work / "images" / "scan-set.json")
    voxel = given.voxel_mm or 1e3 * 0.5 * 6.0 * np.tan(np.radians(85) / 2) * 2 / np.sqrt(1.25e6 * given.megapixels)
    fusing = run("fuse", work / "images", "--out", work / "fused", "--tiles", "--voxel-m", f"{1e-3 * voxel:.3g}", "--device", "cpu")
    fused = json.loads((work / "fused" / "report.json").read_text())
    off = surface_errors(scene, work / "fused" / "tiles", common_motion(work / "registered", truth))
    print(f"surface: {fused['vertices']} vertices in {fused['tiles']} tiles, voxel {voxel:.3g} mm; off by {1e3 * np.median(off):.3g} mm "
          f"(median), {1e3 * np.percentile(off, 95):.3g} mm (95 %); {fusing}", flush=True)
    row = (f"| {datetime.now(UTC):%Y-%m-%d} | {given.scans} | {points:.2g} | {len(errors)} | {1e3 * far[:, 0].max():.2g} / "
           f"{1e3 * near[:, 0].max():.2g} mm | {1e3 * np.median(off):.2g} mm | {1e3 * np.percentile(off, 95):.2g} mm | {voxel:.3g} mm | "
           f"{registering.peak_bytes / 1e9:.2g} / {fusing.peak_bytes / 1e9:.2g} GB | {registering.processor_s:.0f} / "
           f"{fusing.processor_s:.0f} s |")
    print(row)
    if given.write is not None:
        text = given.write.read_text(encoding="utf-8")
        given.write.write_text(text.replace(END, f"{row}\n{END}"), encoding="utf-8")
    shutil.rmtree(work)


if __name__ == "__main__":
    main()
