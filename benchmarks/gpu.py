"""The kernels on a GPU against the speed of its memory: `make gpu-bench`, which needs nothing but the checkout, Warp and NumPy.

    python -m benchmarks.gpu                # cuda:0
    python -m benchmarks.gpu --device cpu   # the same table on the CPU
    python -m benchmarks.gpu --no-tests     # without the kernel tests before it
    python -m benchmarks.gpu --write        # put the table into docs/figures.md

Where torch or the extra `gpu` (cuBLAS) is installed, its products of the same stack are timed in the same run. Bytes are those that the
work must read or write once; `of copy` is their rate over that of a copy on the device.
"""

import argparse
import importlib.util
import re
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels import packs
from kernels.errors import DeviceError
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.readings import grey_factors, grey_readings, pad_lights
from kernels.photometric.lambertian.robust import solve_robust
from kernels.photometric.model.samples import gather
from kernels.photometric.search.hypotheses import Diffuse
from kernels.photometric.svbrdf import solve_svbrdf
from kernels.relight.frames import cublas
from kernels.relight.frames.combine import combine, combine_batch
from kernels.structured.pattern_frames import NoiseModel, upload
from kernels.structured.phase import decode_phase
from kernels.structured.unwrap import unwrap_jointly
from kernels.surface.integrate import integrate_normals
from kernels.tof.continuous.continuous import Noise, decode

HOME = Path(__file__).resolve().parents[1]
FIGURES, HEADING = HOME / "docs" / "figures.md", "## On a GPU"
GREY = (0.299, 0.587, 0.114)
LIGHTS, FRAMES, REPEATS = 96, 32, 9
PERIODS, STEPS = (16.0, 17.0, 19.0, 23.0), 4
SIZES = {"cuda": (2048, 512), "cpu": (512, 64)}
"""Side of the images, and of those of the general solver, in pixels; by kind of device."""


class Table:
    """Rows of measured work on one device."""

    def __init__(self, device: str) -> None:
        self.device, self.lines = device, ["| work | first run, s | ms | Mpixel/s | GB/s | of copy |", "|---|---|---|---|---|---|"]
        self._copy = 0.0

    def seconds(self, work: Callable[[], object]) -> tuple[float, float]:
        """Return the seconds of the first run, in which kernels are compiled or loaded, and the median of those that follow."""
        taken = []
        for _ in range(REPEATS + 1):
            wp.synchronize_device(self.device)
            began = time.perf_counter()
            work()
            wp.synchronize_device(self.device)
            taken.append(time.perf_counter() - began)
        return taken[0], float(np.median(taken[1:]))

    def row(self, name: str, work: Callable[[], object], pixels: int, bytes_moved: int) -> None:
        """Time a piece of work and add its row."""
        first, usual = self.seconds(work)
        rate = bytes_moved / usual / 1e9
        self._copy = self._copy or rate  # the first row is the copy
        speed = f"{1e3 * usual:.2f} | {pixels / usual / 1e6:.1f} | {rate:.0f} | {rate / self._copy:.2f}"
        self.lines.append(f"| {name} | {first:.2f} | {speed} |")
        print(self.lines[-1], flush=True)

    def absent(self, name: str, why: str = "not installed") -> None:
        """Add the row of what cannot be measured here."""
        self.lines.append(f"| {name} | {why} | – | – | – | – |")
        print(self.lines[-1], flush=True)


def scene(rng: np.random.Generator, pixels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions to the lights [lights, 3], normals [pixels, 3] and images [3, lights, pixels] half of a matt surface with noise."""
    directions = rng.normal(size=(LIGHTS, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.3
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normal = rng.normal(size=(pixels, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    grey = (np.maximum(directions @ normal.T, 0) * rng.lognormal(0, 0.03, (LIGHTS, pixels)) / np.pi).astype(np.float16)
    return directions, normal.astype(np.float32), np.stack([grey] * 3)


def measure(device: str) -> list[str]:
    """Return the table as lines of Markdown."""
    table, rng = Table(device), np.random.default_rng(0)
    side, small = SIZES["cpu" if device == "cpu" else "cuda"]
    pixels = side * side
    directions, normal, images = scene(rng, pixels)
    lights = pad_lights(directions, np.ones((LIGHTS, 3)))
    factors = grey_factors(lights, GREY)
    band = packs.upload(images, device=device)
    stack, frame = images.nbytes, 3 * pixels * 4
    target = wp.empty_like(band.values)
    table.row("copy of the stack", lambda: wp.copy(target, band.values), pixels, 2 * stack)
    weights = rng.random((FRAMES, 3, LIGHTS), dtype=np.float32)
    table.row("relight, 1 frame", lambda: combine(band, weights[0]), pixels, stack + frame)
    many = FRAMES * pixels, stack + FRAMES * frame
    table.row(f"relight, {FRAMES} frames", lambda: combine_batch(band, weights, with_cublas=False), *many)
    name = f"relight, {FRAMES} frames, cuBLAS (extra `gpu`)"
    if cublas.product_of(device) is None:
        table.absent(name, "not on the CPU" if device == "cpu" else cublas.describe(device).partition(":")[0])
    else:
        table.row(name, lambda: combine_batch(band, weights), *many)
    _torch_rows(table, images, weights, pixels, stack, frame)
    table.row("`lambert`", lambda: solve_lambert(band, grey_readings(band, factors), lights.direction), pixels, stack)
    table.row("`robust`", lambda: solve_robust(band, grey_readings(band, factors), lights.direction), pixels, stack)
    few = small * small
    view = np.tile(np.array([0, 0, 1], dtype=np.float32), (few, 1))
    samples = gather(packs.upload(images[:, :, :few], device=device), np.arange(few), view, lights, factors, LIGHTS)
    table.row("`svbrdf`, search and material", lambda: solve_svbrdf(samples, normal[:few], shape=Diffuse()), few, stack * few // pixels)
    column = rng.uniform(0, 1280, pixels)
    patterns = [0.45 + 0.35 * np.cos(2 * np.pi * (column / period - step / STEPS)) for period in PERIODS for step in range(STEPS)]
    projected = upload(np.stack(patterns).astype(np.float32), device=device)
    shifts = [step / STEPS for step in range(STEPS)] * len(PERIODS)
    periods = [period for period in PERIODS for _ in range(STEPS)]
    table.row("16 phase images, unwrapped", lambda: unwrap_jointly(decode_phase(
        projected, range(len(periods)), periods, shifts, noise=NoiseModel(0.003, 1e-4)), extent=1280.0), pixels, len(patterns) * pixels * 4)
    raw = (1000 + 300 * rng.random((9, pixels))).astype(np.float32)
    hz, delta = np.repeat([16e6, 80e6, 120e6], 3), np.tile(2 * np.pi * np.arange(3) / 3, 3)
    table.row("9 time-of-flight images, with upload", lambda: decode(raw, hz, delta, noise=Noise(1.0, 5.0), device=device), pixels,
              raw.nbytes)
    y, x = (plane.astype(np.float32) for plane in np.mgrid[side / 2: -side / 2: -1, -side / 2: side / 2])
    bump = -np.stack([x, y, -np.full_like(x, side)]) / np.sqrt(x * x + y * y + np.float32(side) ** 2)
    mask = x * x + y * y < (0.45 * side) ** 2
    table.row("normals to height, with upload", lambda: integrate_normals(
        bump, mask, x, y, perspective=False, mean_z=0.0, device=device).height.numpy(), pixels, bump.nbytes)
    return table.lines


def _torch_rows(table: Table, images: np.ndarray, weights: np.ndarray, pixels: int, stack: int, frame: int) -> None:
    """Add the same products by torch, whose matrix product on CUDA is cuBLAS."""
    names = "torch, 1 frame", f"torch, {FRAMES} frames"
    if importlib.util.find_spec("torch") is None:
        for name in names:
            table.absent(name)
        return
    torch: Any = importlib.import_module("torch")
    kind = torch.float32 if table.device == "cpu" else torch.float16
    there, given = (torch.from_numpy(array).to(table.device, kind) for array in (images, np.ascontiguousarray(weights.swapaxes(0, 1))))

    def product(count: int) -> None:
        torch.bmm(given[:, :count], there)
        if table.device != "cpu":
            torch.cuda.synchronize()

    table.row(names[0], lambda: product(1), pixels, stack + frame)
    table.row(names[1], lambda: product(FRAMES), FRAMES * pixels, stack + FRAMES * frame)


def write(lines: list[str]) -> None:
    """Put the section into docs/figures.md, in place of an older one."""
    text = FIGURES.read_text(encoding="utf-8")
    older = re.search(rf"{HEADING}\n.*?(?=\n## |\Z)", text, re.DOTALL)
    section = "\n".join([HEADING, "", *lines]) + "\n"
    FIGURES.write_text(text.replace(older.group(), section) if older else f"{text.rstrip()}\n\n{section}", encoding="utf-8")


def main() -> int:
    """Run the kernel tests on the device, then measure; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda:0", help="cuda:0 (default), another device, or cpu")
    parser.add_argument("--no-tests", action="store_true", help="do not run the kernel tests before")
    parser.add_argument("--write", action="store_true", help="put the table into docs/figures.md")
    args = parser.parse_args()
    try:
        device = devices.resolve(args.device)
    except DeviceError as error:
        print(error, file=sys.stderr)
        return 1
    tested = "the kernel tests were not run"
    if not args.no_tests:
        if importlib.util.find_spec("pytest") is None:
            tested = "the kernel tests were not run: pytest is not installed"
        elif subprocess.run([sys.executable, "-m", "pytest", "-q", "-x", "tests/kernels", "-k", device.split(":")[0]], cwd=HOME,
                            check=False).returncode:
            print("the kernel tests fail on this device: nothing is measured", file=sys.stderr)
            return 1
        else:
            tested = "the kernel tests pass on it"
    print(f"{devices.describe(device)}: {tested}")
    lines = [f"{devices.describe(device)}, {LIGHTS} lights, Warp {wp.__version__}; {tested}. Medians of {REPEATS} runs in one process.", "",
             *measure(device), "", f"*{date.today().isoformat()}*"]
    if args.write:
        write(lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
