"""Render a light-stage turntable: twelve views of the owl at half its size, each with its lamps and a projector's patterns, and the truth.

    python samples/make_turntable.py --out turntable        # about 20 minutes on 2 idle cores, outside the repository

`views/000` … `views/330` are captures by one perspective camera, of the object turned by that many degrees: 32 distant lights, then
phase shifting of three periods, white and black, with shot and read noise. `scan-set.json` names the results that `relit solve` and
`relit depth` make of them, and the pose of each view. `unseen_*.exr` is the object from between and above the views, under one
light each, without noise, and `truth.npz` its mesh. A run that was interrupted is completed by running it again. Nothing of it is
committed; `python -m benchmarks.turntable` measures what becomes of it. See samples/README.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import rendering

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # relit's camera, patterns and turntable: stage

import capture_files
import make_rig
import rig_scene
import scene_owl

from stage.capture.camera import Camera
from stage.capture.projector import Projector
from stage.patterns.base import uniform_patterns
from stage.patterns.phase import phase_patterns
from stage.sets.scan_set import Turntable
from stage.transforms import rotation_about, rotation_about_y

VIEWS, SIZE_PX, FOCAL_PX, DISTANCE_M = 12, 512, 2140.0, 0.55
SCALE = 0.5  # of the owl of samples/owl: 0.1 m tall
LIGHTS, LARGEST_ANGLE_DEGREES, IRRADIANCE = 32, 80.0, 3.0
PROJECTOR_PX, PROJECTOR_FOCAL_PX, PROJECTOR_ANGLE_DEGREES = (256, 192), 800.0, 20.0
PERIODS_PX = (16, 18, 21)
MAX_DEPTH = 6
PATTERN_SEED = 1000
"""The same for all patterns: a camera's pixel covers the same surface in each."""
FULL_WELL, READ_NOISE = 20_000.0, 4.0  # electrons
UNSEEN = {"unseen_a": (15.0, 0.0, 3), "unseen_b": (135.0, 25.0, 14), "unseen_c": (255.0, 10.0, 22)}
"""Turn of the table and height of the camera above its level, degrees, and the light that is on."""
TABLE = Turntable(axis_point_m=(0.0, 0.0, -DISTANCE_M), axis=(0.0, 1.0, 0.0))


def camera() -> Camera:
    """Return the camera, which stands still."""
    return Camera(projection="perspective", resolution=(SIZE_PX, SIZE_PX), focal_px=(FOCAL_PX, FOCAL_PX), surface_z_m=-DISTANCE_M + 0.02)


def projector() -> Projector:
    """Return the projector beside the camera, which looks at the axis of the table."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_about_y(PROJECTOR_ANGLE_DEGREES)
    pose[:3, 3] = np.array([0.0, 0.0, -DISTANCE_M]) + pose[:3, :3] @ [0.0, 0.0, DISTANCE_M]
    return Projector.model_validate({"resolution": PROJECTOR_PX, "focal_px": (PROJECTOR_FOCAL_PX, PROJECTOR_FOCAL_PX),
                                     "principal_px": (PROJECTOR_PX[0] / 2, PROJECTOR_PX[1] / 2),
                                     "camera_from_projector": pose.round(9).tolist()})


def world_from_camera(turn: float, height: float = 0.0) -> np.ndarray:  # -> [4, 4]
    """Return the pose of the camera around an object that stands still, for a turn of the table and a height of the camera, degrees."""
    up = np.eye(4)
    up[:3, :3] = rotation_about((1.0, 0.0, 0.0), -height)
    up[:3, 3] = np.array(TABLE.axis_point_m) - up[:3, :3] @ np.array(TABLE.axis_point_m)
    return TABLE.pose_at(turn) @ up


def sensor(mi, pose: np.ndarray):
    """Return Mitsuba's camera at a pose, with a box filter."""
    return mi.load_dict({
        "type": "perspective", "fov": float(np.degrees(2 * np.arctan(0.5 * SIZE_PX / FOCAL_PX))), "fov_axis": "x", "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f(pose @ np.diag([-1.0, 1.0, -1.0, 1.0])),  # its devices look along +z with +x to their left
        "film": rendering.film(SIZE_PX, SIZE_PX), "sampler": {"type": "multijitter"}})


def covered(mi, scene, pose: np.ndarray) -> np.ndarray:  # -> [rows, cols] bool
    """Return the pixels whose corners and centre all show the object."""
    row, column = np.mgrid[:SIZE_PX, :SIZE_PX]
    inside = np.ones((SIZE_PX, SIZE_PX), dtype=bool)
    for du, dv in ((0.5, 0.5), (0, 0), (1, 0), (0, 1), (1, 1)):
        inside &= np.array(scene.ray_test(rays(mi, pose, column + du, row + dv))).reshape(inside.shape)
    return inside


def rays(mi, pose: np.ndarray, u: np.ndarray, v: np.ndarray):
    """Return Mitsuba's rays through continuous image coordinates of the camera at a pose."""
    x, y = camera().plane_at(u, v)
    direction = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ pose[:3, :3].T
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return mi.Ray3f(mi.Point3f(*map(float, pose[:3, 3])), mi.Vector3f(np.ascontiguousarray(direction.T.astype(np.float32))))


def render_view(mi, shapes: dict, folder: Path, turn: float, spp: int) -> None:
    """Render the capture of one view; its manifest is written last."""
    folder.mkdir(parents=True, exist_ok=True)
    pose, devices = world_from_camera(turn), projector()
    tracer = rendering.Tracer(mi, shapes, sensor(mi, pose), max_depth=MAX_DEPTH)
    mask = covered(mi, mi.load_dict({"type": "scene", **shapes}), pose)
    capture_files.write_mask(folder / "mask.png", mask)
    directions = rendering.fibonacci_cap(LIGHTS, LARGEST_ANGLE_DEGREES)
    placed = devices.model_copy(update={"camera_from_projector": tuple(map(tuple, pose @ np.array(devices.camera_from_projector)))})
    patterns = (*phase_patterns("column", PERIODS_PX, 4), *uniform_patterns())
    entries: list[dict] = []

    def add(name: str, entry: dict, make: Callable[[], np.ndarray]) -> None:
        """Render a frame with noise, unless it is there."""
        if not (folder / name).exists():
            image = make() * mask[..., None]
            noisy = make_rig.with_noise(image, full_well=FULL_WELL, read_noise=READ_NOISE, seed=int(turn) * 100 + len(entries))
            capture_files.write_rgb(folder / name, noisy.astype(np.float32), note=f"turned by {turn:g} degrees, frame {len(entries)}")
        entries.append({"image": name} | entry)

    for number, direction in enumerate(directions):
        add(f"light_{number:02d}.exr",
            {"light": {"type": "distant", "direction": [round(float(x), 8) for x in direction], "irradiance": [IRRADIANCE] * 3}},
            partial(tracer.light, direction=pose[:3, :3] @ direction, irradiance=np.full(3, IRRADIANCE), spp=spp, seed=number + 1))
    u = np.arange(PROJECTOR_PX[0]) + 0.5
    for number, pattern in enumerate(patterns):
        level = pattern.level(u, np.zeros_like(u), PROJECTOR_PX[0]).astype(np.float32)
        emitter = rig_scene.emitter(mi, placed, np.tile(level, (PROJECTOR_PX[1], 1)))
        add(f"pattern_{number:02d}.exr", {"pattern": pattern.model_dump(mode="json", exclude_none=True)},
            partial(tracer.emitters, {"projector": emitter}, spp=spp, seed=PATTERN_SEED))
    capture_files.write_json(folder / "capture.json", {
        "schema": "relit.capture/1", "name": f"owl {turn:g}", "color_space": "lin_rec709_scene",
        "camera": camera().model_dump(mode="json", exclude_none=True),
        "projector": devices.model_dump(mode="json", exclude_none=True), "mask": "mask.png", "frames": entries})


def write_truth(mi, shapes: dict, surfaces: dict, path: Path, turns: list[float]) -> None:
    """Write the meshes, and what the pixels of all views show of them: points and normals, in the frame of the table at 0 degrees."""
    scene = mi.load_dict({"type": "scene", **shapes})
    row, column = np.mgrid[:SIZE_PX, :SIZE_PX]
    points, normals = [], []
    for turn in turns:
        pose = world_from_camera(turn)
        inside = covered(mi, scene, pose).ravel()
        si = scene.ray_intersect(rays(mi, pose, column + 0.5, row + 0.5))
        points.append(np.array(si.p).T[inside])
        normals.append(np.array(si.sh_frame.n).T[inside])
    before = np.cumsum([0, *(len(part.points) for part in surfaces.values())])
    np.savez(path, points=np.concatenate([part.points for part in surfaces.values()]),
             faces=np.concatenate([part.faces + first for part, first in zip(surfaces.values(), before, strict=False)]),
             normals=np.concatenate([part.normals for part in surfaces.values()]), seen_points=np.concatenate(points),
             seen_normals=np.concatenate(normals))


def main() -> None:
    """Render what is still missing."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--spp", type=int, default=16, help="paths per pixel and frame, a square number (default 16)")
    parser.add_argument("--detail", type=float, default=0.06, help="mesh edge of the owl in centimetres (default 0.06)")
    args = parser.parse_args()
    started = time.perf_counter()
    mi = rendering.import_mitsuba()
    args.out.mkdir(parents=True, exist_ok=True)
    surfaces = {name: part._replace(points=part.points * SCALE + [0, 0, -DISTANCE_M])
                for name, part in scene_owl.build(detail=args.detail).items()}
    shapes = {name: rendering.mesh(mi, name, part) for name, part in surfaces.items()}
    turns = [360.0 / VIEWS * number for number in range(VIEWS)]
    for turn in turns:
        folder = args.out / "views" / f"{turn:03.0f}"
        if not (folder / "capture.json").exists():
            render_view(mi, shapes, folder, turn, args.spp)
            print(f"view of {turn:g} degrees, {time.perf_counter() - started:.0f} s", flush=True)
    unseen = []
    for name, (turn, height, number) in UNSEEN.items():
        pose, lamp = world_from_camera(turn, height), rendering.fibonacci_cap(LIGHTS, LARGEST_ANGLE_DEGREES)[number]
        tracer = rendering.Tracer(mi, shapes, sensor(mi, pose), max_depth=MAX_DEPTH)
        image = tracer.light(direction=pose[:3, :3] @ lamp, irradiance=np.full(3, IRRADIANCE), spp=256, seed=5000, passes=4)
        capture_files.write_rgb(args.out / f"{name}.exr", image, note="an unseen view, path traced")
        unseen.append({"image": f"{name}.exr", "world_from_camera": pose.round(12).tolist(), "direction": lamp.tolist(),
                       "irradiance": [IRRADIANCE] * 3})
    write_truth(mi, shapes, surfaces, args.out / "truth.npz", turns)
    capture_files.write_json(args.out / "unseen.json", {"camera": camera().model_dump(mode="json", exclude_none=True), "views": unseen})
    capture_files.write_json(args.out / "scan-set.json", {
        "schema": "relit.scan-set/1", "name": "owl on a turntable",
        "scans": [{"name": f"{turn:03.0f}", "path": f"depth/{turn:03.0f}", "maps": f"solved/{turn:03.0f}",
                   "scan_to_world": TABLE.pose_at(turn).round(12).tolist()} for turn in turns]})


if __name__ == "__main__":
    main()
