"""Peak memory on a synthetic capture of 4096 x 4096 pixels and 64 lights: it must not grow with the capture."""

import argparse
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from stage import exr
from stage.manifest import SCHEMA, Manifest, write_manifest


def make_capture(folder: Path, side: int, lights: int) -> None:
    """Write a bumpy Lambertian capture, half EXR, without a mask."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(lights, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.5
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    v, u = np.mgrid[0:side, 0:side].astype(np.float32) * np.float32(2 * np.pi * 8 / side)
    normal = np.stack([-0.4 * np.cos(u) * np.cos(v), -0.4 * np.sin(u) * np.sin(v), np.ones_like(u)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = np.array([0.6, 0.5, 0.4], dtype=np.float32)
    frames = []
    for index, direction in enumerate(directions):
        name = f"{index:03d}.exr"
        shading = np.maximum(normal @ direction.astype(np.float32), 0)[..., None] * albedo / np.float32(np.pi)
        exr.write(folder / name, dict(zip("RGB", np.moveaxis(shading.astype(np.float16), -1, 0), strict=True)),
                  color_space="lin_rec709_scene", metadata={})
        frames.append({"image": name, "light": {"type": "distant", "direction": direction.tolist(), "irradiance": [1, 1, 1]}})
    write_manifest(Manifest.model_validate({
        "schema": SCHEMA, "name": "large", "camera": {"projection": "orthographic", "resolution": [side, side]},
        "frames": frames}), folder / "capture.json")
    environment = np.ones((64, 128, 3), dtype=np.float16)
    exr.write(folder / "environment.exr", dict(zip("RGB", np.moveaxis(environment, -1, 0), strict=True)),
              color_space="lin_rec709_scene", metadata={})


def measure(*arguments: str) -> tuple[float, float]:
    """Run relit in a child process.

    Returns:
        Seconds, and peak resident memory in GiB.
    """
    before = time.perf_counter()
    code = "import resource, sys; from service.cli.main import main\n" \
           "try:\n    main()\nfinally:\n    print('peak', resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    result = subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)
    peak = int(result.stdout.split("peak")[-1])
    return time.perf_counter() - before, peak / 2**20


def large_rows(folder: Path, side: int = 4096, lights: int = 64) -> list[str]:
    """Return the table rows: the command, its seconds, and its peak memory."""
    capture, out = folder / "large", folder / "large-out"
    make_capture(capture, side, lights)
    rows = []
    try:
        for what, arguments in (
            ("ingest and solve, robust", ("solve", str(capture), "--out", str(out), "--method", "robust")),
            ("solve again, from the cache", ("solve", str(capture), "--out", str(out), "--method", "robust")),
            ("relight, 4 frames", ("relight", str(capture), "--environment", str(capture / "environment.exr"),
                                   "--out", str(out / "frame.####.exr"), "--frames", "1-4")),
        ):
            seconds, peak = measure(*arguments)
            rows.append(f"| {what} | {seconds:.0f} | {peak:.2f} |")
    finally:
        shutil.rmtree(capture, ignore_errors=True)
        shutil.rmtree(out, ignore_errors=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where about 12 GiB may be written and are removed again")
    parser.add_argument("--side", type=int, default=4096)
    parser.add_argument("--lights", type=int, default=64)
    given = parser.parse_args()
    print("\n".join(large_rows(given.folder, given.side, given.lights)))
    print(f"of making it: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
