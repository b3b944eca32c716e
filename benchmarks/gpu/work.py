"""What is timed: the work of the kernels in batches of the size that the product gives a device, against a plain copy on it."""

import importlib
import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import warp as wp

from benchmarks.gpu.checks import GREY, NOISE, PERIODS, STEPS, WIDTH
from kernels import device as devices
from kernels import packs
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.readings import Lights, grey_factors, grey_readings, pad_lights
from kernels.photometric.lambertian.robust import solve_robust
from kernels.photometric.material.mixtures import HELD
from kernels.photometric.model.samples import gather
from kernels.photometric.search.hypotheses import LobeShape
from kernels.photometric.svbrdf import solve_svbrdf
from kernels.relight.frames.combine import combine, combine_batch
from kernels.structured.pattern_frames import upload
from kernels.structured.phase import decode_phase
from kernels.structured.unwrap import unwrap_jointly
from kernels.surface.integrate import integrate_normals
from kernels.tof.continuous.continuous import Noise, decode

LIGHTS, FRAMES = 96, 32
STACK_BYTES = 6 * LIGHTS
"""The bytes that one pixel of the stack has: three half values for each light."""
SAMPLE_BYTES = 4 * (7 + HELD) * LIGHTS
"""The bytes of one sampled pixel with what the general solver holds: grey, colour, direction."""
CPU_BYTES = 32 << 20
"""Batch on the CPU, so that the table takes a minute."""
MOST_PIXELS = 1 << 22
"""Most pixels of a batch, of which the host holds 5 GB at one time."""
MOST_SAMPLED = 1 << 18
"""Most pixels that the general solver is given: some seconds a run."""
PATTERN_PIXELS = 1 << 16
"""Pixels that are computed; larger images repeat them."""
REPEATS = 9


class Table:
    """Rows of measured work on one device."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.lines = ["| work | first run, s | ms | Mpixel/s | GB/s | of copy | launches |", "|---|---|---|---|---|---|---|"]
        self._copy = 0.0

    def seconds(self, work: Callable[[], object]) -> list[float]:
        """Return the seconds of each run; in the first kernels are compiled or loaded."""
        taken = []
        for _ in range(REPEATS + 1):
            wp.synchronize_device(self.device)
            began = time.perf_counter()
            work()
            wp.synchronize_device(self.device)
            taken.append(time.perf_counter() - began)
        return taken

    def row(self, name: str, work: Callable[[], object], pixels: int, bytes_moved: int) -> None:
        """Time a piece of work and add its row; where memory is short, say so."""
        try:
            with counted_launches() as launches:
                first, *later = self.seconds(work)
        except RuntimeError as error:
            if "allocate" not in str(error):
                raise
            self.absent(name, "skipped: too little memory on the device")
            return
        usual = float(np.median(later))
        rate = bytes_moved / usual / 1e9
        self._copy = self._copy or rate  # the first row is the copy
        speed = f"{1e3 * usual:.2f} | {pixels / usual / 1e6:.1f} | {rate:.0f} | {rate / self._copy:.2f}"
        self._add(f"| {name} | {first:.2f} | {speed} | {len(launches) // (REPEATS + 1)} |")

    def absent(self, name: str, why: str) -> None:
        """Add the row of what is not measured here."""
        self._add(f"| {name} | {why} | – | – | – | – | – |")

    def _add(self, line: str) -> None:
        self.lines.append(line)
        print(line, flush=True)


@contextmanager
def counted_launches() -> Iterator[list[devices.Recorded]]:
    """Yield a list to which each launch is added."""
    launches: list[devices.Recorded] = []
    plain = devices.Recorded.run

    def run(recorded: devices.Recorded) -> None:
        launches.append(recorded)
        plain(recorded)

    with patch.object(devices.Recorded, "run", run):
        yield launches


def batch_pixels(device: str, bytes_per_pixel: int, most: int) -> int:
    """Return the pixels of a batch as the product cuts it, whole packs, `most` at most."""
    return max(PATTERN_PIXELS, min(devices.batch_bytes(device, CPU_BYTES) // bytes_per_pixel, most)) // PATTERN_PIXELS * PATTERN_PIXELS


def repeated(values: np.ndarray, pixels: int) -> np.ndarray:
    """Return [..., pixels] values that repeat those of a few pixels."""
    return np.tile(values, (1,) * (values.ndim - 1) + (pixels // values.shape[-1],))


def scene(rng: np.random.Generator) -> tuple[Lights, np.ndarray, np.ndarray]:
    """Return lights, normals [pixels, 3] and images [3, lights, pixels] half of PATTERN_PIXELS of a matt surface with noise."""
    directions = rng.normal(size=(LIGHTS, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.3
    normal = rng.normal(size=(PATTERN_PIXELS, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    for vectors in (directions, normal):
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    grey = (np.maximum(directions @ normal.T, 0) * rng.lognormal(0, 0.03, (LIGHTS, PATTERN_PIXELS)) / np.pi).astype(np.float16)
    return pad_lights(directions, np.ones((LIGHTS, 3))), normal.astype(np.float32), np.stack([grey] * 3)


def measure(device: str) -> list[str]:
    """Return the table as lines of Markdown; each part frees its memory before the next."""
    table, rng = Table(device), np.random.default_rng(0)
    lights, normal, few = scene(rng)
    _stacks(table, rng, lights, few)
    _general(table, lights, normal, few)
    _depths(table, rng)
    _height(table)
    return table.lines


def _stacks(table: Table, rng: np.random.Generator, lights: Lights, few: np.ndarray) -> None:
    """Time what reads a whole stack."""
    device, pixels, factors = table.device, batch_pixels(table.device, STACK_BYTES, MOST_PIXELS), grey_factors(lights, GREY)
    images = repeated(few, pixels)
    band = packs.upload(images, device=device)
    stack, frame = images.nbytes, 3 * pixels * 4
    target = wp.empty_like(band.values)
    table.row("copy of the stack", lambda: wp.copy(target, band.values), pixels, 2 * stack)
    table.row("upload of the stack", lambda: packs.upload(images, device=device), pixels, stack)
    table.row("a frame to the host", lambda: target[: 3 * 2].numpy(), pixels, frame)
    weights = rng.random((FRAMES, 3, LIGHTS), dtype=np.float32)
    table.row("relight, 1 frame", lambda: combine(band, weights[0]), pixels, stack + frame)
    table.row(f"relight, {FRAMES} frames", lambda: combine_batch(band, weights), FRAMES * pixels, stack + FRAMES * frame)
    _torch(table, images, weights)
    table.row("`lambert`", lambda: solve_lambert(band, grey_readings(band, factors), lights.direction), pixels, stack)
    table.row("`robust`", lambda: solve_robust(band, grey_readings(band, factors), lights.direction), pixels, stack)


def _torch(table: Table, images: np.ndarray, weights: np.ndarray) -> None:
    """Time the same products by torch, whose matrix product on CUDA is cuBLAS."""
    if importlib.util.find_spec("torch") is None:
        table.absent(f"torch, 1 and {FRAMES} frames", "skipped: torch is not installed")
        return
    torch: Any = importlib.import_module("torch")
    kind = torch.float32 if table.device == "cpu" else torch.float16
    there, given = (torch.from_numpy(array).to(table.device, kind) for array in (images, np.ascontiguousarray(weights.swapaxes(0, 1))))

    def product(count: int) -> None:
        torch.bmm(given[:, :count], there)
        if table.device != "cpu":
            torch.cuda.synchronize()

    pixels = images.shape[2]
    for count in (1, FRAMES):
        table.row(f"torch, {count} frames", lambda count=count: product(count), count * pixels, images.nbytes + 12 * count * pixels)


def _general(table: Table, lights: Lights, normal: np.ndarray, few: np.ndarray) -> None:
    """Time the general solver on one of its batches."""
    device, factors = table.device, grey_factors(lights, GREY)
    pixels = min(batch_pixels(device, SAMPLE_BYTES, MOST_SAMPLED), devices.batch_bytes(device, CPU_BYTES) // SAMPLE_BYTES)
    start = np.resize(normal, (pixels, 3))
    band = packs.upload(np.resize(few, (3, LIGHTS, pixels)) if pixels < PATTERN_PIXELS else repeated(few, pixels), device=device)
    samples = gather(band, np.arange(pixels), np.tile(np.array([0, 0, 1], dtype=np.float32), (pixels, 1)), lights, factors, LIGHTS)
    table.row("`svbrdf`, search and material", lambda: solve_svbrdf(samples, start, shape=LobeShape()), pixels, STACK_BYTES * pixels)


def _depths(table: Table, rng: np.random.Generator) -> None:
    """Time the decoders of phases and of time of flight."""
    device, pixels = table.device, batch_pixels(table.device, STACK_BYTES, MOST_PIXELS)
    at = rng.uniform(0, WIDTH, PATTERN_PIXELS)
    periods, shifts = np.repeat(PERIODS, STEPS).tolist(), [step / STEPS for step in range(STEPS)] * len(PERIODS)
    shown = np.cos(2 * np.pi * (at / np.array(periods)[:, None] - np.array(shifts)[:, None]))
    frames = upload(repeated((0.45 + 0.35 * shown).astype(np.float32), pixels), device=device)
    table.row("16 phase images, unwrapped", lambda: unwrap_jointly(
        decode_phase(frames, range(len(periods)), periods, shifts, noise=NOISE), extent=WIDTH), pixels, len(periods) * pixels * 4)
    raw = repeated((1000 + 300 * rng.random((9, PATTERN_PIXELS))).astype(np.float32), pixels)
    hz, delta = np.repeat([16e6, 80e6, 120e6], 3), np.tile(2 * np.pi * np.arange(3) / 3, 3)
    table.row("9 time-of-flight images, with upload", lambda: decode(raw, hz, delta, noise=Noise(1.0, 5.0), device=device), pixels,
              raw.nbytes)


def _height(table: Table) -> None:
    """Time the integration of normals, a ball in an image of a batch."""
    side = int(batch_pixels(table.device, STACK_BYTES, MOST_PIXELS) ** 0.5)
    y, x = (plane.astype(np.float32) for plane in np.mgrid[side / 2 : -side / 2 : -1, -side / 2 : side / 2][:, :side, :side])
    normal = -np.stack([x, y, -np.full_like(x, side)]) / np.sqrt(x * x + y * y + np.float32(side) ** 2)
    mask = x * x + y * y < (0.45 * side) ** 2
    table.row("normals to height, with transfers", lambda: integrate_normals(
        normal, mask, x, y, perspective=False, mean_z=0.0, device=table.device).height.numpy(), side * side, normal.nbytes)
