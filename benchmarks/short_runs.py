"""Seconds of short runs, for the user who waits: `python -m benchmarks.short_runs` prints the table of docs/figures.md. It makes its
captures by itself.

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
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np

from benchmarks.start import ENVIRONMENT
from stage.ingest import CACHE_FOLDER

HOME = Path(__file__).resolve().parents[1]
RUNS = 5
IDLE, LOOK_S, PATIENCE_S = 0.8, 0.5, 400.0
"""The part of all cores that other programs leave idle before a run starts, the seconds in which it is measured, and the seconds that all
runs together wait for it."""
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
    subprocess.run([sys.executable, *run.arguments], cwd=HOME, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                   check=True)
    seconds, after = time.perf_counter() - began, os.times()
    return seconds, after.children_user + after.children_system - before.children_user - before.children_system


def core_seconds() -> tuple[float, float]:
    """Return the seconds that all cores were idle since the start of the machine, and all their seconds, as Linux counts them."""
    counts = [int(word) for word in Path("/proc/stat").read_text(encoding="utf-8").split("\n")[0].split()[1:]]
    return float(counts[3]), float(sum(counts))


def wait_until_idle(deadline: float) -> None:
    """Wait until other programs leave the cores idle, but not beyond a time of `time.monotonic`; not at all on other systems than Linux."""
    while sys.platform == "linux" and time.monotonic() < deadline:
        before = core_seconds()
        time.sleep(LOOK_S)
        idle, whole = (after - first for after, first in zip(core_seconds(), before, strict=True))
        if idle >= IDLE * whole:
            return


def short_runs_table(runs: int = RUNS, *, demo: bool = False) -> list[str]:
    """Make the captures, time the commands in turn, and return the best of each as lines of Markdown.

    Args:
        runs: of each command, after one that is not timed.
        demo: whether to time the demo too, which takes longer than all others.
    """
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        full, rti, tiny, out = folder / "full", folder / "rti", folder / "tiny", folder / "out"
        make_capture(full, FULL_SIZE, FULL_RADIUS, LIGHTS, ".jpg")
        make_capture(rti, RTI_SIZE, RTI_RADIUS, LIGHTS, ".jpg")
        make_capture(tiny, TINY_SIZE, TINY_RADIUS, TINY_LIGHTS, ".png")
        solve = [*RELIT, "solve", "--out", str(out), "--device", "cpu"]
        commands = {
            "`python -c pass`": Run(["-c", "pass"]),
            "`import warp`": Run(["-c", "import warp"]),
            "`relit --help`": Run([*RELIT, "--help"]),
            "`relit solve` of 16 images of 4096 pixels, `lambert`": Run([*solve, str(tiny), "--method", "lambert"]),
            "the same, with the method that Relit chooses": Run([*solve, str(tiny)]),
            "`relit solve` of 96 JPEGs of 60 000 pixels, `lambert`": Run([*solve, str(full), "--method", "lambert"],
                                                                         lambda: shutil.rmtree(full / CACHE_FOLDER, ignore_errors=True)),
            "`relit solve` of 96 JPEGs of 700 000 pixels, 60 000 in the mask, `lambert`": Run(
                [*solve, str(rti), "--method", "lambert"], lambda: shutil.rmtree(rti / CACHE_FOLDER, ignore_errors=True)),
            "again, with the stack cached": Run([*solve, str(rti), "--method", "lambert"]),
        }
        if demo:
            commands["`relit demo`"] = Run([*RELIT, "demo", "--out", str(folder / "demo"), "--device", "cpu"],
                                           lambda: shutil.rmtree(folder / "demo", ignore_errors=True))
        for run in commands.values():
            measure(run)  # compiles the kernels, and keeps the bytecode of modules
        taken: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
        deadline = time.monotonic() + PATIENCE_S
        for _ in range(runs):
            for name, run in commands.items():
                wait_until_idle(deadline)
                taken[name].append(measure(run))
    rows = [f"| {name} | {min(wall):.2f} | {median(wall):.2f} | {min(cpu):.2f} |"
            for name, each in taken.items() for wall, cpu in [zip(*each, strict=True)]]
    return [f"Each command {runs} times, all of them in turn, with compiled kernels, as far as possible while other work left the machine "
            "idle. The stack is made anew but in the last row.", "",
            "| run | best, s | median, s | CPU s |", "|---|---|---|---|", *rows]


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--runs", type=int, default=RUNS)
    arguments.add_argument("--demo", action="store_true", help="the demo too, which takes longer than all others")
    given = arguments.parse_args()
    print("\n".join(short_runs_table(given.runs, demo=given.demo)))


if __name__ == "__main__":
    main()
