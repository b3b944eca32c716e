"""An estimate for a GPU that is not at hand, from what products ask of a device and from published speeds: a section of docs/figures.md.

    python -m benchmarks.device_estimate svbrdf 64 1 counted 256 1   # what one small scene asks, as JSON; or timed, and own patches

What is asked of the device is counted on an emulated one (tests/emulated_device.py). Small scenes stand for 12 megapixels: all limits of
memory are made small in the same ratio, so that bands, batches and chunks of frames, and so launches and waits, are as many. Bytes, and the
processor seconds of a run on the CPU of this machine, are a + b · pixels. All frames are counted, in as many chunks as at the full size;
their seconds are (a + b · pixels) + frames · (c + d · pixels) + chunks · (e + f · pixels), from two sizes, two counts of frames, and one
count in two chunks. What is bounded by a number of patches or blocks of pixels is the same for both sizes, and is added
by itself: bytes for each patch of bounced light come from a third run with more of them, seconds from one that has as many as the product.
"""

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from pkgutil import resolve_name
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

from kernels import device as devices
from service.relight import relight as product
from service.requests.solve import Method
from service.solve.height import interreflection
from service.solve.methods import settling
from tests import device_ways, emulated_device

PIXELS = 12_000_000
LEAST_BYTES, LEAST_PIXELS = 16 << 20, 1 << 15
"""Constants of the product below these are no limits of memory."""
TIMED_SIDES = 192, 384
FEW_PATCHES, MORE_PATCHES = 256, 1024
"""Patches of bounced light, and blocks whose middles settle it, in the small scenes: exactly as many, because the sides of their images are
multiples of the roots of these numbers."""
BOUNDED_SIDE = 424
"""Side of a scene with as many patches and blocks, and pixels that stand for a patch, as there are at the full size."""
HOST_CORES = 16
"""Cores of a host of one GPU."""
ON_DEVICE = "service.relight.model_range._summed", "service.relight.guide.Guide._add", "warp.array.__del__"
"""Functions of the host, on the CPU, whose work kernels do on CUDA; and what gives memory back, which CUDA's pool keeps."""
PRODUCT_SIDE = 2048
"""Side of the matrices by whose product the speed of a core is measured."""


class Published(NamedTuple):
    """Published speeds of a device and of its link."""

    name: str
    memory_bytes: float
    bytes_per_s: float
    operations_per_s: float
    """In float32, an addition and a multiplication being two."""
    pinned_per_s: float
    pageable_per_s: float
    launch_s: float


H200 = Published("H200 SXM", 141e9, 4.8e12, 67e12, 55e9, 12e9, 3e-6)
SOURCES = ("Memory, its bandwidth and float32 operations: NVIDIA H200 Tensor Core GPU datasheet (2024). The link, PCIe 5.0 × 16, carries "
           "63 GB/s each way (PCI-SIG); copies reach some 55 GB/s from pinned and 12 GB/s from pageable memory. A launch takes 2 to 4 µs "
           "(NVIDIA, \"Getting started with CUDA graphs\", 2019).")


class Work(NamedTuple):
    """What is estimated, and the seconds that it may take."""

    title: str
    run: Callable[[int], Callable[..., object]]
    """Returns a run of tests.device_ways that makes so many frames."""
    frames: int | None
    """None: there are no frames."""
    tried: tuple[int, ...]
    """Counts of frames of the small runs that are timed."""
    sides: tuple[int, int]
    """Sides of the small scenes whose asking is counted: batches of pixels, or patches, are cut into as many parts in both."""
    bar_s: float


WORKS = {
    "svbrdf": Work("`svbrdf`, 12 megapixels × 96 lights", lambda _: device_ways.solving(Method.SVBRDF), None, (1,), (64, 128), 60.0),
    "guided": Work("240 guided frames of 12 megapixels, 96 lights", lambda frames: device_ways.relighting(guided=True, frames=frames), 240,
                   (4, 8), (54, 108), 150.0),
}


def shrink_limits(ratio: float) -> None:
    """Make the limits of memory of the product and of the emulated device small, for the rest of the process."""
    emulated_device.MEMORY = int(H200.memory_bytes * ratio)
    for module in [found for name, found in sys.modules.items() if name.partition(".")[0] in ("kernels", "service", "stage")]:
        for name, value in vars(module).items():
            least = LEAST_BYTES if name.endswith("_BYTES") else LEAST_PIXELS if name.endswith("_PIXELS") else math.inf
            if isinstance(value, int) and value >= least:
                setattr(module, name, max(1, int(value * ratio)))


class Taken:
    """Processor seconds of kernels, and of functions that stand for them, by thread."""

    def __init__(self) -> None:
        self.kernels, self.of_main = 0.0, 0.0
        self._lock, self._inside = threading.Lock(), threading.local()

    def timed(self, plain: Callable[..., object]) -> Callable[..., object]:
        """Return a function that also notes the seconds that its thread takes, unless a noted function calls it."""
        def run(*args: object, **options: object) -> object:
            if getattr(self._inside, "now", False):
                return plain(*args, **options)
            self._inside.now, began = True, time.thread_time()
            try:
                return plain(*args, **options)
            finally:
                self._inside.now, seconds = False, time.thread_time() - began
                with self._lock:
                    self.kernels += seconds
                    self.of_main += seconds if threading.current_thread() is threading.main_thread() else 0
        return run


@contextmanager
def timed_launches() -> Iterator[Taken]:
    """Yield the processor seconds that kernels take on the CPU from here on, where launches then run one after another."""
    taken = Taken()

    def run(recorded: devices.Recorded) -> None:
        for command in recorded._commands:
            command.launch()

    with ExitStack() as stack:
        stack.enter_context(patch.object(devices.Recorded, "run", taken.timed(run)))
        for name in ON_DEVICE:
            stack.enter_context(patch(name, taken.timed(resolve_name(name))))
        yield taken


def measure(work: Work, side: int, frames: int, *, counted: bool, patches: int | None = FEW_PATCHES, chunks: int = 1) -> dict[str, float]:
    """Return what one small scene asks of the emulated device, and in how many chunks of frames, or the processor seconds of kernels and
    host on the CPU, where frames come in so many chunks. `patches`: of bounced light; None: as many of them and of blocks as the product
    takes."""
    devices.names()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if patches is not None:
            stack.enter_context(patch.object(interreflection, "PATCHES", patches))
            stack.enter_context(patch.object(settling, "BLOCKS", FEW_PATCHES))
        device_ways.distant(folder, side)
        run = work.run(frames)
        if counted:
            emulated_device.install()
            shrink_limits(side * side / PIXELS)
            before, guided = emulated_device.counts.copy(), stack.enter_context(patch.object(product, "_guided", wraps=product._guided))
            run(folder, folder / "out", emulated_device.NAME, device_ways.Counting())
            return {**{name: emulated_device.counts[name] - before[name] for name in emulated_device.COUNTED}, "chunks": guided.call_count}
        stack.enter_context(patch.object(product, "MODEL_CHUNK_FRAMES", max(1, frames // chunks)))
        run(folder, folder / "warm", "cpu", device_ways.Counting())  # compiles what is not cached
        shutil.rmtree(folder / "capture" / ".relit")  # decoding is part of the work
        with timed_launches() as taken:
            whole, main = time.process_time(), time.thread_time()
            run(folder, folder / "out", "cpu", device_ways.Counting())
            whole, main = time.process_time() - whole, time.thread_time() - main
        alone = main - taken.of_main
        return {"kernels": taken.kernels, "host": alone, "threads": whole - taken.kernels - alone}


def at_full_size(name: str) -> dict[str, float]:
    """Return the quantities of a work at its full size, each fitted to small runs in processes of their own."""
    work = WORKS[name]
    counts = {side: _run(name, side, work.frames or 1, counted=True) for side in work.sides}
    found = {quantity: float(value) if quantity in ("launches", "waits", "chunks") else _at_pixels(counts, quantity)
             for quantity, value in counts[work.sides[-1]].items()}
    times = {frames: {side: _run(name, side, frames, counted=False) for side in TIMED_SIDES} for frames in work.tried}
    twice = {side: _run(name, side, work.tried[-1], counted=False, chunks=2) for side in TIMED_SIDES} if work.frames else {}
    for quantity in ("kernels", "host", "threads"):
        tried = [_at_pixels(times[frames], quantity) for frames in work.tried]
        found[quantity] = _line(work.tried, tried, work.frames) if work.frames else tried[0]
        if work.frames:
            found[quantity] += (found["chunks"] - 1) * max(0.0, _at_pixels(twice, quantity) - tried[-1])
    if work.frames is None:
        few, more = counts[work.sides[0]], _run(name, work.sides[0], 1, counted=True, patches=MORE_PATCHES)
        for quantity in ("up", "down", "touched"):
            found[quantity] += (more[quantity] - few[quantity]) / (MORE_PATCHES - FEW_PATCHES) * (interreflection.PATCHES - FEW_PATCHES)
        few, own = (_run(name, BOUNDED_SIDE, work.tried[0], counted=False, patches=patches) for patches in (FEW_PATCHES, None))
        for quantity, seconds in own.items():
            found[quantity] += max(0.0, seconds - few[quantity])
    return found


def _at_pixels(runs: dict[int, dict[str, float]], quantity: str) -> float:
    """Return a quantity at the full size, from runs by the sides of their images."""
    return _line([side * side for side in runs], [run[quantity] for run in runs.values()], PIXELS)


def _run(name: str, side: int, frames: int, *, counted: bool, patches: int | None = FEW_PATCHES, chunks: int = 1) -> dict[str, float]:
    """Return what `measure` does in a process of its own, with one thread of BLAS as the program has it: more would wait for each other,
    which takes processor time."""
    command = [sys.executable, "-m", "benchmarks.device_estimate", name, str(side), str(frames), "counted" if counted else "timed",
               str(patches or "own"), str(chunks)]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True,
                                          env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}).stdout))


def _line(at: Sequence[int], values: Sequence[float], wanted: int) -> float:
    """Return the value at a place on the line through two points, or the larger value if it falls."""
    return max(values[0] + (values[1] - values[0]) * (wanted - at[0]) / (at[1] - at[0]), max(values))


def core_speed() -> float:
    """Return the float32 operations that one core of this machine does in a second, in a matrix product by NumPy's BLAS."""
    a = np.ones((PRODUCT_SIDE, PRODUCT_SIDE), dtype=np.float32)
    a @ a
    began = time.process_time()
    a @ a
    return 2 * PRODUCT_SIDE**3 / (time.process_time() - began)


def estimate_rows(device: Published = H200) -> list[str]:
    """Return the section as lines of Markdown."""
    speed = core_speed()
    counted = " and ".join(f"{small} and {large} (`{name}`)" for name, work in WORKS.items() for small, large in [work.sides])
    columns = [_column(work, at_full_size(name), speed, device) for name, work in WORKS.items()]
    return [f"An estimate for one {device.name}, made without one; what a GPU took is in \"Products on a GPU\". Nothing is taken to "
            "overlap. Its terms:", "",
            "- copies: bytes between host and device over the speed of the link",
            "- launches: their number, and that of the reads that wait for the device, times the time of a launch",
            "- memory: bytes of all arrays that launches were given, over the bandwidth",
            "- arithmetic: processor seconds of the kernels on the CPU of this machine, times the float32 operations of a core of it "
            f"({speed / 1e9:.0f} · 10⁹/s in a matrix product) over those of the device: both are taken to reach the same part of their "
            "best",
            "- host: processor seconds of everything else on this machine: decoding, files, and the mathematics that is not on the device. "
            f"What one thread does counts whole; what several do side by side (decoding, writing) is divided among {HOST_CORES} cores", "",
            f"{SOURCES} Counts are those of scenes of {counted} pixels squared on the emulated device, "
            f"seconds of {' and '.join(map(str, TIMED_SIDES))} pixels squared, continued in a line to the full size. For the counts all "
            "limits of memory are made small in the same ratio, so that launches and waits are as many as at the full size; a CUDA graph "
            "is one launch. The frames come in as many chunks as at the full size, where a chunk has as many as 1/16 of the memory of the "
            "device holds; what the model responds is computed again for each. Bytes and seconds for patches of bounced light, "
            f"{interreflection.PATCHES} at most, are counted apart.", "",
            *("| " + " | ".join(cells) + " |" for cells in zip(ROWS, *columns, strict=True))]


ROWS = ("", "---", "chunks of frames", "to the device, GB", "to the host, GB", "both per captured byte", "launches", "waits",
        "copies, pinned memory, s", "copies, pageable memory, s", "launches, s", "memory, s", "arithmetic, s", "host, one thread, s",
        f"host, in threads, on {HOST_CORES} cores, s",
        "**all**, with pageable copies, s", "bar, s")


def _column(work: Work, asked: dict[str, float], speed: float, device: Published) -> list[str]:
    """Return the cells of a work, in the order of ROWS."""
    moved, captured = asked["up"] + asked["down"], PIXELS * device_ways.LIGHTS * 3 * device_ways.HALF
    terms = [moved / device.pageable_per_s, (asked["launches"] + asked["waits"]) * device.launch_s, asked["touched"] / device.bytes_per_s,
             asked["kernels"] * speed / device.operations_per_s, asked["host"], asked["threads"] / HOST_CORES]
    return [work.title, "---", f"{asked['chunks']:.0f}" if work.frames else "", f"{asked['up'] / 1e9:.0f}", f"{asked['down'] / 1e9:.0f}",
            f"{moved / captured:.1f}", f"{asked['launches']:.0f}", f"{asked['waits']:.0f}", f"{moved / device.pinned_per_s:.1f}",
            *(f"{term:.1f}" for term in terms), f"**{sum(terms):.0f}**", f"{work.bar_s:.0f}"]


def main() -> None:
    """Run one small scene, for at_full_size."""
    name, side, frames, kind, patches, chunks = sys.argv[1:]
    print(json.dumps(measure(WORKS[name], int(side), int(frames), counted=kind == "counted",
                             patches=None if patches == "own" else int(patches), chunks=int(chunks))))


if __name__ == "__main__":
    main()
