"""Seconds and peak memory of `relit export` for maps of 4096 x 4096 pixels, each in a process of its own."""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera
from stage.results.maps import MAPS_FILE, SurfaceMaps

SIDE = 4096
HOLE_PX = 12
"""Radius of the holes in the mask, one in each cell of 256 pixels."""
WAYS = ("usdz", "usdz --textures png8", "usdz --levels 2", "usdc --textures exr", "glb --textures png8")
"""Suffix and options."""


class Measured(NamedTuple):
    """One export."""

    seconds: float
    cpu_seconds: float
    peak_gib: float
    megabytes: float


def make_maps(folder: Path, side: int = SIDE) -> None:
    """Write maps of a bumpy surface that is metal in stripes, with holes and a part that floats before the rest."""
    row, col = np.mgrid[:side, :side].astype(np.float32)
    k = np.float32(2 * np.pi * 8 / side)
    height = np.float32(0.004) * np.sin(k * col) * np.cos(k * row)
    pixel = 0.2 / side
    slope_x = np.float32(0.004) * k / pixel * np.cos(k * col) * np.cos(k * row)
    slope_y = np.float32(0.004) * k / pixel * np.sin(k * col) * np.sin(k * row)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(row)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    mask = np.hypot(row % 256 - 128, col % 256 - 128) > HOLE_PX
    mask &= np.hypot(row - side / 2, col - side / 2) < 0.49 * side
    part = np.where(np.hypot(row - side / 3, col - side / 3) < side / 10, 2, 1).astype(np.uint8)
    metal = (np.sin(k * (row + col) / 2) > 0.5).astype(np.float32)
    grain = np.random.default_rng(1).random((side, side), dtype=np.float32)
    albedo = ((1 - metal) * (0.3 + 0.4 * grain))[..., None] * np.array([0.9, 0.6, 0.3], np.float32)
    specular = 0.04 + (metal * (0.5 + 0.3 * grain))[..., None] * np.array([1.0, 0.8, 0.4], np.float32)
    folder.mkdir(parents=True, exist_ok=True)
    SurfaceMaps(camera=Camera(projection="orthographic", resolution=(side, side), pixel_size_m=pixel), mask=mask, normal=normal,
                diffuse_albedo=albedo, specular=specular, roughness=0.3 + 0.4 * grain, height=height + np.float32(0.02) * (part == 2),
                part=np.where(mask, part, 0)).write(folder / MAPS_FILE)


def measure(maps: Path, out: Path, *options: str) -> Measured:
    """Export in a child process."""
    code = "import resource, sys; from service.cli.main import main\n" \
           "try:\n    main()\nfinally:\n    used = resource.getrusage(resource.RUSAGE_SELF)\n" \
           "    print('used', used.ru_maxrss, used.ru_utime + used.ru_stime)"
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code, "export", str(maps), "--out", str(out), *options], check=True, capture_output=True,
                          text=True)
    peak, cpu = done.stdout.split("used")[-1].split()
    beside = [file for file in out.parent.rglob("*") if file.is_file()]
    return Measured(time.perf_counter() - begin, float(cpu), int(peak) / 2**20, sum(file.stat().st_size for file in beside) / 1e6)


def large_export_table(folder: Path, side: int = SIDE) -> list[str]:
    """Return the table as lines of Markdown; needs about 3 GB in the folder."""
    # in a process of its own: the peak memory of a process is never below that of the one that started it
    subprocess.run([sys.executable, "-c", "import sys; from pathlib import Path; from benchmarks.large_export import make_maps\n"
                    "make_maps(Path(sys.argv[1]), int(sys.argv[2]))", str(folder / "maps"), str(side)], check=True)
    lines = ["| file, options | seconds | CPU seconds | peak GiB | MB |", "|---|---|---|---|---|"]
    for way in WAYS:
        suffix, *options = way.split()
        with tempfile.TemporaryDirectory(dir=folder) as out:
            found = measure(folder / "maps", Path(out) / f"asset.{suffix}", *options)
        lines.append(f"| `.{way}` | {found.seconds:.0f} | {found.cpu_seconds:.0f} | {found.peak_gib:.2f} | {found.megabytes:.0f} |")
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where about 3 GB may be written")
    parser.add_argument("--side", type=int, default=SIDE)
    given = parser.parse_args()
    print("\n".join(large_export_table(given.folder, given.side)))
