"""A large capture end to end: seconds and peak memory of every stage of a solve, an export and relit frames.

    python -m benchmarks.large FOLDER                    # 50 megapixels, 64 lights, 100 frames: about 40 GB in the folder, removed again
    python -m benchmarks.large FOLDER --megapixels 4     # less of everything

The capture is synthetic: a bumpy Lambertian surface that fills the frame, with the noise of a camera, as half EXR files. Each command has a
process of its own, and its results are removed when no later one reads them. The peak memory of the process is set back at the
beginning of every stage (Linux: /proc/self/clear_refs), so that each stage shows its own.
"""

import argparse
import json
import math
import os
import re
import resource
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.capture.manifest import SCHEMA, Manifest, write_manifest
from stage.formats import exr

MEGAPIXELS, LIGHTS, FRAMES = 50.0, 64, 100
ASPECT = 1.5
"""Width over height, as of full-frame cameras."""
ROWS = 256
"""Rows of the synthetic images that are computed at one time."""
ELECTRONS, READ_ELECTRONS = 30000, 5
"""Electrons of a pixel of radiance 1, and the noise of reading it."""
COMMANDS = ("solve", "export", "relight")


class Stage(NamedTuple):
    """What a stage of a command took."""

    command: str
    name: str
    seconds: float
    cpu_seconds: float
    """Time of all threads, user and system: what the stage costs however busy the machine is."""
    peak_gib: float


class StagePeaks:
    """A Progress that measures the seconds, CPU seconds and peak resident memory of each stage."""

    def __init__(self, command: str) -> None:
        self._command = command
        self.stages: list[Stage] = []
        self._begin("start")

    def stage(self, name: str, total: int) -> None:
        """End a stage and begin the next."""
        self.close()
        self._begin(name)

    def advance(self, done: int) -> None:
        """Take no note."""

    def close(self) -> None:
        """End the last stage; a stage that recurs is one."""
        now = Stage(self._command, self._name, time.perf_counter() - self._began, time.process_time() - self._cpu_began, peak_gib())
        for place, before in enumerate(self.stages):
            if before.name == now.name:
                self.stages[place] = now._replace(seconds=before.seconds + now.seconds, cpu_seconds=before.cpu_seconds + now.cpu_seconds,
                                                  peak_gib=max(before.peak_gib, now.peak_gib))
                return
        self.stages.append(now)

    def _begin(self, name: str) -> None:
        self._name, self._began, self._cpu_began = name, time.perf_counter(), time.process_time()
        with suppress(OSError):  # without it the peaks are those of the command so far
            Path("/proc/self/clear_refs").write_text("5")  # the peak is that of the present from here


def peak_gib() -> float:
    """Return the peak resident memory since it was set back."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return int(re.search(r"VmHWM:\s+(\d+)", status).group(1)) / 2**20  # type: ignore[union-attr]
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def make_capture(folder: Path, width: int, height: int, lights: int, compression: str) -> None:
    """Write a bumpy Lambertian capture with the noise of a camera, half EXR, without a mask, and an environment."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(lights, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.5
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    u = np.arange(width, dtype=np.float32)[None] * np.float32(2 * np.pi * 8 / width)
    albedo = np.array([0.6, 0.5, 0.4], dtype=np.float32) / np.float32(np.pi)
    noise = rng.standard_normal(4 * ROWS * width, dtype=np.float32)  # taken from another place for each frame and channel

    def write_frame(index: int) -> dict[str, object]:
        x, y, z = directions[index].astype(np.float32)
        places = np.random.default_rng(index)
        image = np.empty((3, height, width), dtype=np.float16)
        for first in range(0, height, ROWS):
            v = np.arange(first, min(first + ROWS, height), dtype=np.float32)[:, None] * np.float32(2 * np.pi * 8 / width)
            slope_x, slope_y = np.float32(-0.4) * np.cos(u) * np.cos(v), np.float32(-0.4) * np.sin(u) * np.sin(v)
            shading = np.maximum((x * slope_x + y * slope_y + z) / np.sqrt(slope_x**2 + slope_y**2 + 1), 0)
            for channel, reflected in enumerate(albedo):
                clean = reflected * shading
                begin = int(places.integers(len(noise) - clean.size))
                sigma = np.sqrt(clean / np.float32(ELECTRONS) + np.float32(READ_ELECTRONS / ELECTRONS) ** 2)
                image[channel, first : first + ROWS] = np.maximum(clean + sigma * noise[begin : begin + clean.size].reshape(clean.shape), 0)
        name = f"{index:03d}.exr"
        exr.write(folder / name, dict(zip("RGB", image, strict=True)), color_space="lin_rec709_scene", metadata={},
                  compression=getattr(exr.Compression, compression))
        return {"image": name, "light": {"type": "distant", "direction": [float(x), float(y), float(z)], "irradiance": [1, 1, 1]}}

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        frames = list(pool.map(write_frame, range(lights)))
    write_manifest(Manifest.model_validate({
        "schema": SCHEMA, "name": "large", "camera": {"projection": "orthographic", "resolution": [width, height]},
        "frames": frames}), folder / "capture.json")
    environment = rng.random((64, 128, 3)).astype(np.float16)
    exr.write(folder / "environment.exr", dict(zip("RGB", np.moveaxis(environment, -1, 0), strict=True)),
              color_space="lin_rec709_scene", metadata={})


def run_command(command: str, folder: Path, method: str, frames: int, compression: str) -> list[Stage]:
    """Run a command in this process, and return its stages."""
    capture, out, peaks = folder / "capture", folder / "out", StagePeaks(command)
    if command == "solve":
        from service.requests.solve import Method, SolveRequest
        from service.solve.solve import solve

        solve(SolveRequest(capture=capture, out=out, method=Method(method)), peaks)
    elif command == "export":
        from service.export.export import export
        from service.requests.export import ExportRequest

        export(ExportRequest(maps=out, out=folder / "asset" / "asset.usdz"), peaks)
    else:
        from service.relight.relight import relight
        from service.requests.light.picture_options import FrameCompression
        from service.requests.relight import RelightRequest

        relight(RelightRequest(capture=capture, environment=capture / "environment.exr", out=str(folder / "frames" / "frame.####.exr"),
                               frames=f"1-{frames}", spin_degrees=360, compression=FrameCompression(compression)), peaks)
    peaks.close()
    return peaks.stages


def measure(command: str, folder: Path, method: str, frames: int, compression: str) -> list[Stage]:
    """Run a command in a process of its own."""
    done = subprocess.run([sys.executable, "-m", "benchmarks.large", str(folder), "--command", command, "--method", method, "--frames",
                           str(frames), "--compression", compression], check=True, capture_output=True, text=True, env=os.environ)
    return [Stage(*values) for values in json.loads(done.stdout.splitlines()[-1])]


def head(width: int, height: int, lights: int, frames: int, method: str, compression: str) -> list[str]:
    """Return the lines above the rows of the table."""
    return [f"{width} × {height} pixels ({width * height / 1e6:.1f} megapixels), {lights} lights, no mask, `{method}`, {frames} frames, "
            f"half EXR ({compression.upper()}) with the noise of a camera, {os.cpu_count()} cores. CPU seconds are those of all "
            "threads. The peak is the resident memory of the process, mapped files included.", "",
            "| command | stage | seconds | CPU seconds | peak, GiB |", "|---|---|---|---|---|"]


def rows(stages: list[Stage]) -> list[str]:
    """Return the rows of a command's stages, and one of them all."""
    command = f"`{stages[0].command}`"
    return [*(f"| {command} | {stage.name} | {stage.seconds:.1f} | {stage.cpu_seconds:.1f} | {stage.peak_gib:.2f} |" for stage in stages),
            sum_row(command, stages)]


def sum_row(command: str, stages: list[Stage]) -> str:
    """Return the row of all these stages: their seconds added up, and the largest peak."""
    seconds, cpu_seconds = sum(stage.seconds for stage in stages), sum(stage.cpu_seconds for stage in stages)
    return f"| {command} | **all** | **{seconds:.0f}** | **{cpu_seconds:.0f}** | **{max(stage.peak_gib for stage in stages):.2f}** |"


def large_table(folder: Path, megapixels: float = MEGAPIXELS, lights: int = LIGHTS, frames: int = FRAMES,
                method: str = "robust", compression: str = "piz") -> list[str]:
    """Return the table as lines of Markdown; the folder is empty again afterwards."""
    height = round(math.sqrt(1e6 * megapixels / ASPECT))
    width = round(1e6 * megapixels / height)
    lines = head(width, height, lights, frames, method, compression)
    work = folder / "relit-large"
    try:
        # in a process of its own: the peak memory of a process is never below that of the one that started it
        subprocess.run([sys.executable, "-c", "import sys; from pathlib import Path; from benchmarks.large import make_capture\n"
                        "make_capture(Path(sys.argv[1]), *map(int, sys.argv[2:5]), sys.argv[5])", str(work / "capture"), str(width),
                        str(height), str(lights), compression.upper()], check=True)
        stages: list[Stage] = []
        for command in COMMANDS:
            measured = measure(command, work, method, frames, compression)
            stages += measured
            found = rows(measured)
            print("\n".join(found), flush=True)
            lines += found
            if command == "export":  # relight reads the capture and the stack beside it
                shutil.rmtree(work / "out")
                shutil.rmtree(work / "asset")
        lines.append(sum_row("all commands", stages))
        print(lines[-1], flush=True)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return lines


def main() -> None:
    """Measure, or run one command of a measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the capture and the results are written and removed again")
    parser.add_argument("--megapixels", type=float, default=MEGAPIXELS)
    parser.add_argument("--lights", type=int, default=LIGHTS)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--method", default="robust")
    parser.add_argument("--compression", choices=("zip", "piz", "dwaa"), default="piz", help="of the capture and of the frames")
    parser.add_argument("--command", choices=COMMANDS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.command is not None:
        print(json.dumps(run_command(given.command, given.folder, given.method, given.frames, given.compression)))
        return
    large_table(given.folder, given.megapixels, given.lights, given.frames, given.method, given.compression)


if __name__ == "__main__":
    main()
