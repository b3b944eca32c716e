"""Speed of the kernels, each as a ratio to NumPy or to a copy of the same data, measured in the same run."""

import time
from collections.abc import Callable

import numpy as np
import warp as wp

from kernels import device as devices
from kernels import packs
from kernels.photometric.lambertian.albedo import fit_albedo
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.readings import grey_factors, grey_readings, pad_lights
from kernels.photometric.lambertian.robust import solve_robust
from kernels.relight.frames.combine import combine, combine_batch
from service.reporting.progress import Progress, Timings
from service.requests.demo import BenchRequest
from stage.colour.colour import GREY_WEIGHTS

LIGHTS, SIDE, FRAMES = 64, 512, 24
"""64 lights of 512 x 512 half, as in docs/figures.md."""


def bench(request: BenchRequest, progress: Progress | None = None) -> list[str]:
    """Measure the speed of the kernels on this machine.
    Returns lines of a Markdown table: what, milliseconds, pixels per second, against what, its milliseconds, ratio (above 1: faster)."""
    timings = Timings(progress)
    name = devices.resolve(request.device)
    timings.stage("bench", 6)
    rng = np.random.default_rng(0)
    pixels = SIDE * SIDE
    dense = rng.random((3, LIGHTS, pixels), dtype=np.float32)
    stack = dense.astype(np.float16)
    band = packs.upload(stack, device=name)
    weights = rng.random((FRAMES, 3, LIGHTS), dtype=np.float32)
    directions = rng.normal(size=(LIGHTS, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.3
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lights = pad_lights(directions, np.ones((LIGHTS, 3)))
    factors = grey_factors(lights, GREY_WEIGHTS)

    def timed(work: Callable[[], object]) -> float:
        work()
        wp.synchronize_device(name)
        seconds = []
        for _ in range(request.repeats):
            began = time.perf_counter()
            work()
            wp.synchronize_device(name)
            seconds.append(time.perf_counter() - began)
        return float(np.median(seconds))

    rows = []

    def row(what: str, ours: float, peer: str, theirs: float, count: int = pixels) -> None:
        rate = count / ours / 1e6
        rows.append(f"| {what} | {1e3 * ours:.2f} | {rate:.1f} | {peer} | {1e3 * theirs:.2f} | {theirs / ours:.2f} |")
        timings.advance(len(rows))

    # the one-channel row: a single plane of the stack as a band of its own
    one = packs.upload(np.ascontiguousarray(np.broadcast_to(stack[:1], (1, LIGHTS, pixels))), device=name)
    single = _one_channel(one, weights[0, :1], name)
    row("relight, one frame, one channel", timed(single), "NumPy float32 BLAS", timed(lambda: weights[0, 0] @ dense[0]))
    row("relight, one frame, RGB", timed(lambda: combine(band, weights[0])), "copy of the stack", timed(_copy(band)))
    row(f"relight, {FRAMES} frames, RGB", timed(lambda: combine_batch(band, weights)), "NumPy float32 BLAS",
        timed(lambda: [weights[:, c] @ dense[c] for c in range(3)]), pixels * FRAMES)
    grey = np.tensordot(np.array(GREY_WEIGHTS, dtype=np.float32), dense, axes=1)

    def lambert() -> None:
        solve_lambert(band, grey_readings(band, factors), lights.direction)

    def robust() -> None:
        readings = grey_readings(band, factors)
        fit_albedo(band, readings, solve_robust(band, readings, lights.direction), lights)

    row("lambert normals", timed(lambert), "NumPy float32 pseudo-inverse of grey",
        timed(lambda: np.linalg.pinv(lights.direction) @ grey))
    row("lambert normals", timed(lambert), "NumPy float32 grey, and that",
        timed(lambda: np.linalg.pinv(lights.direction) @ np.tensordot(np.array(GREY_WEIGHTS, dtype=np.float32), dense, axes=1)))
    row("robust normals and albedo", timed(robust), "lambert normals, above", timed(lambert))
    timings.close()
    return [f"{devices.describe(name)}; {LIGHTS} lights, {SIDE}x{SIDE} half, median of {request.repeats}", "",
            "| what | ms | Mpixel/s | against | ms | ratio |", "|---|---|---|---|---|---|", *rows]


def _one_channel(band: packs.Band, weights: np.ndarray, device: str) -> Callable[[], object]:
    """Return a launch of the combine kernel on a stack of one channel."""
    from kernels.relight.frames import combine as module

    pack = devices.pack_width(device)
    out = packs.zeros(band.pixel_count, wp.float32, device, rows=1)
    on_device = wp.array(weights, dtype=wp.float32, device=device)
    if device == "cpu":
        chunks = -(-band.packs // module.FRAME_CHUNK)
        return lambda: devices.launch(module.frame_chunk_kernel(pack), chunks, [band.values, on_device, chunks],
                                      [packs.as_packs(out, device)], device=device)
    return lambda: devices.launch(module.frame_register_kernel(pack), band.packs, [band.values, on_device],
                                  [packs.as_packs(out, device)], device=device)


def _copy(band: packs.Band) -> Callable[[], object]:
    """Return a copy of as many bytes as one relit frame reads."""
    target = wp.empty_like(band.values)
    return lambda: wp.copy(target, band.values)
