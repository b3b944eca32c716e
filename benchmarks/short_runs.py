"""Seconds of short runs, for the user who waits: `python -m benchmarks.short_runs`. It makes its captures by itself.

Beside each run stands the floor: Python alone, and Python that imports Warp. The commands take turns, so that a busy machine slows all.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from stage.ingest import CACHE_FOLDER

HOME = Path(__file__).resolve().parents[1]
LIGHTS = 96
RTI_SIZE, RTI_RADIUS = (700, 1000), 138
"""Rows and columns of the images, and the radius of the object in them: 60 000 pixels."""
FULL_SIZE, FULL_RADIUS = (200, 300), 190
"""The same number of pixels where the object fills the images."""
TINY_SIZE, TINY_RADIUS, TINY_LIGHTS = (64, 64), 30, 16
NOISE = 0.004
RELIT = ["-m", "service.cli.main"]
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)


class Run(NamedTuple):
    """A command, and what is done before each start of it, which is not timed."""

    arguments: list[str]
    prepare: Callable[[], None] = lambda: None


def make_capture(folder: Path, size: tuple[int, int], radius: int, lights: int, suffix: str) -> None:
    """Write the images of a matt ball under distant lights, its mask and its `.lp` file, and import them."""
    folder.mkdir(parents=True)
    y, x = np.mgrid[: size[0], : size[1]]
    u, v = (x - size[1] / 2) / radius, (size[0] / 2 - y) / radius
    mask = u**2 + v**2 < 1
    normal = np.stack([u, v, np.sqrt(np.maximum(1 - u**2 - v**2, 0))], axis=-1)
    rng = np.random.default_rng(0)
    albedo = 0.3 + 0.4 * (np.sin(x / 9) * np.cos(y / 7) > 0)
    z = 1 - 0.8 * (np.arange(lights) + 0.5) / lights
    turn = GOLDEN_ANGLE * np.arange(lights)
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    for light, direction in enumerate(directions):
        radiance = np.where(mask, albedo * np.maximum(normal @ direction, 0), 0.05) + rng.normal(0, NOISE, size)
        radiance = np.clip(radiance, 0, 1)
        srgb = np.where(radiance <= 0.0031308, 12.92 * radiance, 1.055 * radiance ** (1 / 2.4) - 0.055)
        cv2.imwrite(str(folder / f"{light:03d}{suffix}"), np.repeat((255 * srgb).astype(np.uint8)[..., None], 3, axis=2))
    cv2.imwrite(str(folder / "mask.png"), 255 * mask.astype(np.uint8))
    lines = [f"{light:03d}{suffix} {x} {y} {z}" for light, (x, y, z) in enumerate(directions)]
    (folder / "lights.lp").write_text("\n".join([str(lights), *lines]) + "\n")
    subprocess.run([sys.executable, *RELIT, "import", "lp", str(folder / "lights.lp"), str(folder)], cwd=HOME, stdout=subprocess.DEVNULL,
                   check=True)


def measure(run: Run) -> tuple[float, float]:
    """Return the wall seconds and the CPU seconds of one run."""
    run.prepare()
    before, began = os.times(), time.perf_counter()
    subprocess.run([sys.executable, *run.arguments], cwd=HOME, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
    seconds, after = time.perf_counter() - began, os.times()
    return seconds, after.children_user + after.children_system - before.children_user - before.children_system


def main() -> None:
    """Make the captures, time the commands in turn, and print the best of each."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--runs", type=int, default=5)
    arguments.add_argument("--demo", action="store_true", help="the demo too, which takes longer than all others")
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        full, rti, tiny, out = folder / "full", folder / "rti", folder / "tiny", folder / "out"
        make_capture(full, FULL_SIZE, FULL_RADIUS, LIGHTS, ".jpg")
        make_capture(rti, RTI_SIZE, RTI_RADIUS, LIGHTS, ".jpg")
        make_capture(tiny, TINY_SIZE, TINY_RADIUS, TINY_LIGHTS, ".png")
        solve = [*RELIT, "solve", "--out", str(out), "--device", "cpu"]
        runs = {
            "python -c pass": Run(["-c", "pass"]),
            "import warp": Run(["-c", "import warp"]),
            "relit --help": Run([*RELIT, "--help"]),
            "solve, tiny, lambert": Run([*solve, str(tiny), "--method", "lambert"]),
            "solve, tiny": Run([*solve, str(tiny)]),
            "solve, 96 JPEGs of 60 000 pixels, lambert": Run([*solve, str(full), "--method", "lambert"],
                                                             lambda: shutil.rmtree(full / CACHE_FOLDER, ignore_errors=True)),
            "solve, 96 JPEGs of 700 000 pixels, 60 000 in the mask, lambert": Run(
                [*solve, str(rti), "--method", "lambert"], lambda: shutil.rmtree(rti / CACHE_FOLDER, ignore_errors=True)),
            "again, with the stack cached": Run([*solve, str(rti), "--method", "lambert"]),
        }
        if given.demo:
            runs["demo"] = Run([*RELIT, "demo", "--out", str(folder / "demo"), "--device", "cpu"],
                               lambda: shutil.rmtree(folder / "demo", ignore_errors=True))
        for run in runs.values():
            measure(run)  # compiles the kernels
        taken: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
        for _ in range(given.runs):
            for name, run in runs.items():
                taken[name].append(measure(run))
    print("| run | wall s | CPU s |\n|---|---|---|")
    for name, each in taken.items():
        wall, cpu = (min(column) for column in zip(*each, strict=True))
        print(f"| {name} | {wall:.2f} | {cpu:.2f} |")


if __name__ == "__main__":
    main()
