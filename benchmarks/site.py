"""A simulated site: hundreds of range images of a courtyard from afar and of its statues from near, registered and fused out of core.

Usage: python -m benchmarks.site [--scans 200] [--megapixels 0.05] [--voxel-mm 10] [--work DIR] [--write docs/scans.md]

The courtyard (24 m × 16 m) is walls, columns, blocks and statues of balls in closed form, so that every ray and every distance is exact.
Three of five scans are seen from afar (85° across, σ of 0.5 mm and 0.1 ‰ of the depth), the others from 1.3 m before a statue (32° across,
σ of 0.1 mm, nothing beyond 2.2 m); one in ten is a PLY cloud in millimetres. Poses start 20 mm and 0.2°
off from afar, and 4 mm and 0.2° from near. `relit register` and `relit fuse --tiles` run as processes of their own, of which the memory and
the time are told. A run that was stopped goes on where it was when it is begun again with the same folder.
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
from scipy.spatial.transform import Rotation

from benchmarks.site_scene import STATUES, Scene, distance, look, make_scene
from service.scans.points.ply_points import read_ply_points
from service.scans.points.rigid import inverse, rigid_between
from stage.capture.camera import Camera
from stage.files import write_text
from stage.formats.ply import PointCloud, write_ply
from stage.results.depth_maps import DepthMaps
from stage.sets.scan_set import ScanEntry, ScanSet, read_scan_set, write_scan_set
from tests.reference.projector import look_at

FAR_SHARE, CLOUD_EVERY = 0.6, 10
FAR_DEGREES, NEAR_DEGREES = 85.0, 32.0
NEAR_M, NEAR_RANGE_M = 1.3, 2.2
FAR_OFF, NEAR_OFF, TURN_OFF = 0.02, 0.004, np.radians(0.2)
MOST_CHECKED = 100_000
"""Vertices whose distance from the true surface is computed, of all in equal steps."""
LOOK_S = 5.0
"""Seconds after which it is written down again what a process has taken so far."""
MARK, END = "<!-- made by benchmarks.site -->", "<!-- end of the site -->"


class Truth(NamedTuple):
    """What is known of a scan that was made."""

    pose: np.ndarray  # [4, 4]
    middle: np.ndarray  # [3] of its points, world
    size: float  # metres, RMS distance of its points from there
    far: bool
    points: int


def write_site(scene: Scene, folder: Path, count: int, pixels: float) -> dict[str, Truth]:
    """Write scans one by one, but those that are there already, and return the truth of each by its name."""
    cols = round(np.sqrt(pixels * 1.25))
    entries, truth = [], {}
    for number in range(count):
        name = f"{'far' if number < round(FAR_SHARE * count) else 'near'}{number:03d}"
        known, entry = folder / "known" / f"{name}.json", None
        if known.exists():
            read = json.loads(known.read_text())
            truth[name] = Truth(np.array(read["pose"]), np.array(read["middle"]), read["size"], read["far"], read["points"])
            entry = ScanEntry.model_validate(read["entry"])
        else:
            truth[name], entry = write_scan(scene, folder, name, number, count, (cols, round(cols / 1.25)))
            plain = truth[name]._asdict() | {"pose": truth[name].pose.tolist(), "middle": truth[name].middle.tolist()}
            write_text(known, json.dumps(plain | {"entry": entry.model_dump(mode="json")}))
        entries.append(entry)
    write_scan_set(ScanSet(schema="relit.scan-set/1", name="site", scans=tuple(entries)), folder / "scan-set.json")
    return truth


def write_scan(scene: Scene, folder: Path, name: str, number: int, count: int, shape: tuple[int, int]) -> tuple[Truth, ScanEntry]:
    """Write one scan of so many columns and rows, the same whichever others are written."""
    rng = np.random.default_rng([1, number])
    far_count = round(FAR_SHARE * count)
    far = number < far_count
    if far:
        turn = 2 * np.pi * 0.381966 * number
        eye = np.array([rng.uniform(-8.5, 8.5), rng.uniform(1.5, 2.5), rng.uniform(-1.5, 1.5)])
        pose = look_at(eye, eye + np.array([np.cos(turn), rng.uniform(-0.2, 0.0), np.sin(turn)]))
    else:
        statue = scene.statues[number % STATUES]
        turn = 2 * np.pi * (number // STATUES) / max((count - far_count) / STATUES, 1) + 0.3 * (number % STATUES)
        pose = look_at(statue + NEAR_M * np.array([np.cos(turn), rng.uniform(-0.1, 0.4), np.sin(turn)]), statue)
    focal = shape[0] / 2 / np.tan(np.radians(FAR_DEGREES if far else NEAR_DEGREES) / 2)
    camera = Camera(projection="perspective", resolution=shape, focal_px=(focal, focal))
    depth = look(scene, camera, pose)
    mask = depth > 0 if far else (depth > 0) & (depth < NEAR_RANGE_M)
    sigma = np.where(mask, 5e-4 + 1e-4 * depth if far else 1e-4, 0).astype(np.float32)
    noisy = np.where(mask, depth + sigma * rng.standard_normal(depth.shape, dtype=np.float32), 0).astype(np.float32)
    own = camera.points(-noisy)[mask]
    middle = own.mean(axis=0, dtype=np.float64)
    size = float(np.sqrt(((own - middle.astype(np.float32)) ** 2).sum(axis=1).mean(dtype=np.float64)))
    start = pose.copy()
    start[:3, :3] = Rotation.from_rotvec(rng.normal(scale=TURN_OFF, size=3)).as_matrix() @ pose[:3, :3]
    start[:3, 3] = pose[:3, 3] + rng.normal(scale=FAR_OFF if far else NEAR_OFF, size=3)
    more = {}
    if number % CLOUD_EVERY == CLOUD_EVERY - 1:
        write_ply(PointCloud((1000 * own).astype(np.float32), np.zeros((len(own), 3), dtype=np.uint8)), folder / f"{name}.ply")
        more = {"unit": "mm", "sigma_m": float(np.median(sigma[mask])), "viewpoint_m": (0.0, 0.0, 0.0)}
    else:
        DepthMaps(camera=camera, mask=mask, depth=noisy, sigma=sigma).write(folder / name / "depth.exr")
    entry = ScanEntry(name=name, path=f"{name}.ply" if more else name, **more, scan_to_world=tuple(tuple(map(float, row)) for row in start))
    return Truth(pose, pose[:3, :3] @ middle + pose[:3, 3], size, far, len(own)), entry


class Cost(NamedTuple):
    """What the attempts of one command have taken together."""

    processor_s: float
    peak_bytes: int
    attempts: int
    ended: bool


def run(*command: object, note: Path) -> Cost:
    """Run a relit command unless it has ended before, and return what it took with what earlier attempts did, which `note` tells."""
    before = Cost(**json.loads(note.read_text())) if note.exists() else Cost(0.0, 0, 0, False)
    if before.ended:
        return before
    process = subprocess.Popen([sys.executable, "-m", "service.cli.main", *map(str, command)], stdout=sys.stderr)

    def noted(processor_s: float, peak: int, ended: bool) -> Cost:
        cost = Cost(before.processor_s + processor_s, max(before.peak_bytes, peak), before.attempts + 1, ended)
        write_text(note, json.dumps(cost._asdict()))
        return cost

    while True:
        found, status, usage = os.wait4(process.pid, os.WNOHANG)
        if found:
            break
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        peak = next((int(line.split()[1]) for line in Path(f"/proc/{process.pid}/status").read_text().splitlines()
                     if line.startswith("VmHWM")), 0)
        noted((int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"), 1024 * peak, False)
        time.sleep(LOOK_S)
    if (code := os.waitstatus_to_exitcode(status)) not in (0, 1):
        raise SystemExit(f"relit {command[0]} ended with {code}")
    return noted(usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024, True)


def pose_errors(registered: Path, truth: dict[str, Truth]) -> dict[str, tuple[float, float]]:
    """By how much each pose is wrong, after the best common motion of all: metres at the middle of its points, and degrees."""
    found = poses_of(registered)
    true = np.concatenate([truth[name].middle + truth[name].size * np.concatenate([np.eye(3), -np.eye(3)]) for name in found])
    placed = np.concatenate([(truth[name].middle + truth[name].size * np.concatenate([np.eye(3), -np.eye(3)]) - truth[name].pose[:3, 3])
                             @ truth[name].pose[:3, :3] @ pose[:3, :3].T + pose[:3, 3] for name, pose in found.items()])
    common = rigid_between(placed[None], true[None], np.ones((1, len(true))))[0]
    out = {}
    for name, pose in found.items():
        out[name] = off_by(common @ pose, truth[name])
    return out


def off_by(pose: np.ndarray, true: Truth) -> tuple[float, float]:
    """Return by how much a pose in the true world is wrong: metres at the middle of its points, and degrees."""
    motion = pose @ inverse(true.pose)
    cosine = np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(motion[:3, :3] @ true.middle + motion[:3, 3] - true.middle)), float(np.degrees(np.arccos(cosine)))


def surface_errors(scene: Scene, tiles: Path, motion: np.ndarray) -> np.ndarray:
    """Distances of vertices of all tiles from the true surface, metres, after a motion [4, 4]."""
    files = sorted(tiles.glob("*.ply"))
    total = sum(len(read_ply_points(path).points) for path in files)
    step = max(1, total // MOST_CHECKED)
    found = [distance(scene, read_ply_points(path).points[::step] @ motion[:3, :3].T + motion[:3, 3]) for path in files]
    return np.concatenate(found)


def common_motion(registered: Path, truth: dict[str, Truth]) -> np.ndarray:
    """[4, 4] true world from the world of the found poses."""
    found = [(truth[name], pose) for name, pose in poses_of(registered).items()]
    true = np.stack([each.middle for each, _ in found])
    placed = np.stack([pose[:3, :3] @ (each.pose[:3, :3].T @ (each.middle - each.pose[:3, 3])) + pose[:3, 3] for each, pose in found])
    return np.asarray(rigid_between(placed[None], true[None], np.ones((1, len(true))))[0])


def poses_of(registered: Path) -> dict[str, np.ndarray]:
    """Return world_from_scan [4, 4] of each scan that has a pose."""
    return {entry.name: np.array(entry.scan_to_world) for entry in read_scan_set(registered)[1].scans if entry.scan_to_world is not None}


def errors_in_sigmas(registered: Path, truth: dict[str, Truth]) -> dict[str, tuple[float, float]]:
    """Return the errors of place and turn of each scan against the reference in their stated standard deviations; 1 is expected (RMS)."""
    report, found = json.loads((registered / "report.json").read_text()), poses_of(registered)
    reference = report["reference"]
    common = truth[reference].pose @ inverse(found[reference])
    out = {}
    for scan in report["scans"]:
        if scan["name"] in found and scan["name"] != reference:
            place, turn = off_by(common @ found[scan["name"]], truth[scan["name"]])
            out[scan["name"]] = place / scan["pose_sigma_m"], turn / scan["pose_sigma_degrees"]
    return out


def claim(work: Path, **given: object) -> None:
    """Take note of what the site in a folder is made of, and refuse a folder with another one."""
    note = work / "site.json"
    if note.exists() and json.loads(note.read_text()) != given:
        raise SystemExit(f"--work {work}: holds another site, {note.read_text()}: delete it, or give another folder")
    write_text(note, json.dumps(given))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--megapixels", type=float, default=0.05, help="of each scan; 5.5 makes 10⁹ points of 200 scans")
    parser.add_argument("--voxel-mm", type=float, help="default: half the median pixel of the scans from afar")
    parser.add_argument("--work", type=Path, default=Path("site-work"), help="folder for the scans and results, deleted at the end")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--keep", action="store_true", help="do not delete the folder at the end")
    parser.add_argument("--until", choices=("scans", "registration"), help="stop when this is done; a further run goes on")
    parser.add_argument("--write", type=Path, help="page whose table gets a row")
    given = parser.parse_args()
    scene, work = make_scene(), given.work
    claim(work, scans=given.scans, megapixels=given.megapixels)
    began = time.process_time()
    truth = write_site(scene, work / "scans", given.scans, 1e6 * given.megapixels)
    points = sum(each.points for each in truth.values())
    print(f"{given.scans} scans, {points:.4g} points, written in {time.process_time() - began:.0f} s of processor time; load "
          f"{os.getloadavg()[0]:.0f} on {os.cpu_count()} cores", flush=True)
    if given.until == "scans":
        return
    registering = run("register", work / "scans", "--out", work / "registered", "--threads", given.threads, "--cache", work / "register",
                      note=work / "register.json")
    errors = pose_errors(work / "registered", truth)
    report = json.loads((work / "registered" / "report.json").read_text())
    far = np.array([errors[name] for name in errors if truth[name].far]).reshape(-1, 2)
    near = np.array([errors[name] for name in errors if not truth[name].far]).reshape(-1, 2)
    for words, values in (("far", far), ("near", near)):
        print(f"{words}: {len(values)} joined; place median {1e3 * np.median(values[:, 0]):.3g} mm, largest "
              f"{1e3 * values[:, 0].max():.3g} mm; turn largest {values[:, 1].max():.3g}°", flush=True)
    in_sigmas = errors_in_sigmas(work / "registered", truth)
    off = np.array(list(in_sigmas.values()))
    print(f"error over σ, place and turn: RMS {np.sqrt((off**2).mean(axis=0)).round(2)}, largest {off.max(axis=0).round(2)} "
          f"({max(in_sigmas, key=lambda name: in_sigmas[name][0])})", flush=True)
    print(f"pairs {len(report['pairs'])}, joined {sum(pair['state'] == 'joined' for pair in report['pairs'])}, not tried "
          f"{report['pairs_not_tried']}; {registering}", flush=True)
    if given.until == "registration":
        return
    file, listed = read_scan_set(work / "registered")
    placed = [entry for entry in listed.scans if entry.scan_to_world is not None]
    write_scan_set(listed.model_copy(update={"scans": tuple(entry.model_copy(update={"path": str((file.parent / entry.path).resolve())})
                                                            for entry in placed)}), work / "placed" / "scan-set.json")
    voxel = given.voxel_mm or 1e3 * 0.5 * 6.0 * np.tan(np.radians(FAR_DEGREES) / 2) * 2 / np.sqrt(1.25e6 * given.megapixels)
    fusing = run("fuse", work / "placed", "--out", work / "fused", "--tiles", "--voxel-m", f"{1e-3 * voxel:.3g}", "--device", "cpu",
                 "--cache", work / "fuse", note=work / "fuse.json")
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
    if not given.keep:
        shutil.rmtree(work)


if __name__ == "__main__":
    main()
