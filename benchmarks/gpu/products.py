"""The product on a GPU at full size: seconds of each stage of a solve and of relit frames.

    python -m benchmarks.gpu.products FOLDER                   # 12.6 megapixels, 96 lights, 240 frames: 45 GB in the folder, removed again
    python -m benchmarks.gpu.products FOLDER --tiles 6         # 3.1 megapixels
    python -m benchmarks.gpu.products FOLDER --write           # put the table into docs/figures.md

The capture is a glossy dome of 256 pixels squared with noise, repeated side by side; each work begins with its kernels compiled.
"""

import argparse
import json
import os
import shutil
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path

import numpy as np

from benchmarks.gpu.__main__ import put_section
from benchmarks.large import StagePeaks
from kernels import device as devices
from service.relight.relight import relight
from service.requests.relight import LightWeights, RelightRequest
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.formats import exr
from tests.device_ways import LIGHTS, distant

SIDE, TILES, FRAMES = 256, 12, 240
"""Pixels along a side of the dome; domes in a column, of which a row has a third more; relit frames."""
HEADING = "## Products on a GPU"
BRIEF_S = 0.5
"""Stages that take less are not named."""


def write_capture(folder: Path, tiles: int) -> tuple[int, int]:
    """Write the repeated domes; return the rows and columns of the images."""
    distant(folder / "dome", SIDE)
    rows, cols = tiles, tiles * 4 // 3
    manifest = json.loads((folder / "dome/capture/capture.json").read_text())
    manifest.pop("mask")
    manifest["camera"]["resolution"] = [cols * SIDE, rows * SIDE]
    capture = folder / "capture"
    capture.mkdir()

    def write(frame: dict[str, str]) -> None:
        layers = exr.read(folder / "dome/capture" / frame["image"])[0]
        exr.write(capture / frame["image"], {name: np.tile(values.astype(np.float16), (rows, cols)) for name, values in layers.items()},
                  color_space="lin_rec709_scene", metadata={}, compression=exr.Compression.ZIP)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(write, manifest["frames"]))
    (capture / "capture.json").write_text(json.dumps(manifest))
    return rows * SIDE, cols * SIDE


def row(name: str, work: Callable[[StagePeaks], object]) -> str:
    """Do work; return its row of the table."""
    peaks = StagePeaks(name)
    work(peaks)
    peaks.close()
    named = ", ".join(f"{stage.name} {stage.seconds:.1f}" for stage in peaks.stages if stage.seconds >= BRIEF_S)
    line = f"| {name} | {sum(stage.seconds for stage in peaks.stages):.1f} | {named} |"
    print(line, flush=True)
    return line


def measure(folder: Path, frames: int, device: str) -> list[str]:
    """Return the rows of the table."""
    capture, sky = folder / "capture", folder / "dome/sky.exr"

    def solved(method: Method) -> str:
        request = SolveRequest(capture=capture, out=folder / method.value, method=method, device=device)
        return row(f"solve, `{method.value}`", lambda peaks: solve(request, peaks))

    def relit(name: str, maps: Path | None) -> str:
        request = RelightRequest(capture=capture, environment=sky, out=str(folder / "frames" / "f.#.exr"), frames=f"1-{frames}",
                                 spin_degrees=60, weights=None if maps else LightWeights.CELLS, maps=maps, device=device)
        line = row(f"relight, {frames} {name} frames", lambda peaks: relight(request, peaks))
        shutil.rmtree(folder / "frames")
        return line

    return [solved(Method.LAMBERT), solved(Method.SVBRDF), relit("plain", None), relit("guided", folder / Method.SVBRDF.value)]


def main(arguments: list[str] | None = None) -> int:
    """Measure; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="where the capture and the results lie while it runs")
    parser.add_argument("--tiles", type=int, default=TILES, help=f"domes in a column of the image, {TILES} by default")
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"relit frames, {FRAMES} by default")
    parser.add_argument("--device", default="cuda:0", help="cuda:0 (default), another device, or cpu")
    parser.add_argument("--write", action="store_true", help="put the table into docs/figures.md")
    args = parser.parse_args(arguments)
    device = devices.resolve(args.device)
    folder = args.folder / "relit-gpu-products"
    folder.mkdir(parents=True)
    try:
        rows, cols = write_capture(folder, args.tiles)
        head = f"{devices.describe(device)}, {os.cpu_count()} cores, {rows * cols / 1e6:.1f} megapixels, {LIGHTS} lights."
        print(head)
        lines = [f"{head} {EXPLAINED}", "", *TITLE, *measure(folder, args.frames, device), "", f"*{date.today().isoformat()}*"]
    finally:
        shutil.rmtree(folder)
    if args.write:
        put_section(HEADING, lines)
    return 0


TITLE = ["| work | seconds | stages |", "|---|---|---|"]
EXPLAINED = "Seconds of the wall clock, one run, with reading and writing the files; no stage is named that takes less than half a second."

if __name__ == "__main__":
    sys.exit(main())
