"""Decoding projected codes: the kernels against the same arithmetic in vectorised NumPy, and a Python loop over pixels, in one run.

`python -m benchmarks.structured` prints the table of docs/figures.md: 12 megapixels on the CPU. NumPy works in float32 and band by
band, as the kernels' callers do, in bands that suit its caches; the loop is timed on a few pixels, and is what per-pixel decoders
in Python come to.
"""

import sys
from collections.abc import Callable

import numpy as np

from benchmarks.timing import run_seconds
from kernels import device as devices
from kernels.structured.binary import decode_gray
from kernels.structured.pattern_frames import NoiseModel, upload
from kernels.structured.phase import decode_phase
from kernels.structured.unwrap import unwrap_jointly
from stage.patterns.binary import gray_of

PIXELS, LOOP_PIXELS, BAND = 12_000_000, 20_000, 65_536
PERIODS, STEPS, WIDTH = (16.0, 17.0, 19.0, 23.0), 4, 1280
NOISE = NoiseModel(0.003, 1e-4)
BITS = 11


def least_seconds(work: Callable[[], object], repeats: int = 5) -> float:
    """Return the seconds of the fastest of several runs, which other processes disturbed least."""
    return min(run_seconds(work, repeats))


def phase_frames(pixels: int) -> np.ndarray:
    """Return phase-shift frames [16, pixels] float32."""
    u = np.random.default_rng(0).uniform(0, WIDTH, pixels).astype(np.float32)
    return np.stack([0.45 + 0.35 * np.cos(2 * np.pi * (u / period - step / STEPS)) for period in PERIODS for step in range(STEPS)]
                    ).astype(np.float32)


def gray_frames(pixels: int) -> np.ndarray:
    """Return Gray-code frames [24, pixels] float32: bits, inverses, white, black."""
    code = gray_of(np.random.default_rng(0).integers(0, WIDTH, pixels))
    bits = np.stack([(code >> bit & 1) for bit in range(BITS)]).astype(np.float32)
    return np.concatenate([0.05 + 0.7 * bits, 0.75 - 0.7 * bits, np.full((1, pixels), 0.75, np.float32),
                           np.full((1, pixels), 0.05, np.float32)])


def numpy_phase(frames: np.ndarray, whole: bool) -> np.ndarray:
    """Compute phase and amplitude by least squares of even steps; `whole` adds offset, uncertainty and status, as the kernel gives them."""
    angles = 2 * np.pi * np.arange(STEPS) / STEPS
    rows = np.stack([np.full(STEPS, 0.5), np.cos(angles), np.sin(angles)]).astype(np.float32) * np.float32(2 / STEPS)
    squares = np.stack([rows[0] ** 2, rows[1] ** 2, rows[2] ** 2, rows[1] * rows[2]])
    out = np.empty((5 * len(PERIODS), frames.shape[1]), np.float32)
    for start in range(0, frames.shape[1], BAND):
        band = slice(start, start + BAND)
        for period in range(len(PERIODS)):
            readings = frames[STEPS * period:STEPS * (period + 1), band]
            a, c, s = rows @ readings
            amplitude = np.sqrt(c * c + s * s)
            out[5 * period, band] = np.arctan2(s, c)
            out[5 * period + 1, band] = amplitude
            if not whole:
                continue
            variance = np.float32(NOISE.read**2) + np.float32(NOISE.gain) * np.maximum(readings, 0)
            vaa, vcc, vss, vcs = squares @ variance
            over = 1 / (amplitude * amplitude)
            out[5 * period + 2, band] = a
            out[5 * period + 3, band] = np.sqrt(c * c * vss + s * s * vcc - 2 * c * s * vcs) * over
            swing_variance = (c * c * vcc + s * s * vss + 2 * c * s * vcs) * over
            out[5 * period + 4, band] = ((a > 5 * np.sqrt(vaa)) & (amplitude * amplitude > 25 * swing_variance)
                                         & (amplitude > np.float32(0.02) * a))
    return out


def numpy_unwrap(phases: np.ndarray) -> np.ndarray:
    """Return the wrap of the shortest period with the least errors of the others, without weights and status."""
    out = np.empty(phases.shape[1], np.float32)
    turns = phases[::2] / np.float32(2 * np.pi)
    for start in range(0, phases.shape[1], BAND):
        part = turns[:, start:start + BAND]
        best, place = np.full(part.shape[1], np.inf, np.float32), np.zeros(part.shape[1], np.float32)
        for wrap in range(int(np.ceil(WIDTH / PERIODS[0])) + 1):
            u = (part[0] + np.float32(wrap)) * np.float32(PERIODS[0])
            cost = np.zeros_like(u)
            for period, turn in zip(PERIODS[1:], part[1:], strict=True):
                rest = u / np.float32(period) - turn
                rest -= np.rint(rest)
                cost += rest * rest
            better = cost < best
            best, place = np.where(better, cost, best), np.where(better, u, place)
        out[start:start + BAND] = place
    return out


def numpy_gray(frames: np.ndarray, whole: bool) -> np.ndarray:
    """Return stripe numbers where every difference is above a threshold; `whole` weighs noise and tries doubtful bits both ways."""
    out = np.empty(frames.shape[1], np.float32)
    for start in range(0, frames.shape[1], BAND):
        part = frames[:, start:start + BAND]
        contrast = part[-2] - part[-1]
        lit = contrast > 0.05
        shown, doubt = np.zeros(part.shape[1], np.int32), np.zeros(part.shape[1], np.int32)
        for index in range(BITS):
            difference = part[index] - part[BITS + index]
            shown += (difference > 0).astype(np.int32) << index
            if whole:
                variance = np.float32(2 * NOISE.read**2) + np.float32(NOISE.gain) * (part[index] + part[BITS + index])
                limit = np.maximum(9 * variance, np.float32(0.0025) * contrast * contrast)
                doubt += (difference * difference < limit).astype(np.int32) << index
            else:
                lit &= np.abs(difference) > 0.02
        if not whole:
            out[start:start + BAND] = np.where(lit, number_of(shown), -1)
            continue
        low = doubt & -doubt
        rest = doubt & (doubt - 1)
        second = rest & -rest
        read = [number_of(shown ^ flips) for flips in (0, low, second, low ^ second)]
        least, most = np.minimum.reduce(read), np.maximum.reduce(read)
        good = lit & ((rest & (rest - 1)) == 0) & (most - least <= 1) & (least < WIDTH)
        out[start:start + BAND] = np.where(good, 0.5 * (least + most + 1), -1)
    return out


def number_of(gray: np.ndarray) -> np.ndarray:
    """Return the number of a Gray code of up to sixteen bits."""
    for shift in (1, 2, 4, 8):
        gray = gray ^ gray >> shift
    return gray


def loop_gray(frames: np.ndarray) -> list[int]:
    """Decode pixel by pixel in Python, as the callers of OpenCV's Gray-code class do (here with the arithmetic of its call)."""
    numbers = []
    for pixel in frames.T:
        number, bit = 0, False
        for index in reversed(range(BITS)):
            bit ^= bool(pixel[index] > pixel[BITS + index])
            number += bit << index
        numbers.append(number)
    return numbers


def structured_rows(pixels: int = PIXELS) -> list[str]:
    """Return the table as lines of Markdown."""
    stack = phase_frames(pixels)
    frames = upload(stack, device="cpu")
    numbers, periods = range(len(stack)), [period for period in PERIODS for _ in range(STEPS)]
    shifts = [step / STEPS for _ in PERIODS for step in range(STEPS)]
    rows = []
    ours = least_seconds(lambda: decode_phase(frames, numbers, periods, shifts, noise=NOISE))
    whole, bare = (least_seconds(lambda full=full: numpy_phase(stack, full)) for full in (True, False))
    rows.append(("16 images, 4 periods: phase, amplitude, offset, uncertainty, status", ours, whole, bare, None))
    wrapped = decode_phase(frames, numbers, periods, shifts, noise=NOISE)
    phases = numpy_phase(stack, False)[[row for period in range(len(PERIODS)) for row in (5 * period, 5 * period + 1)]]
    both = least_seconds(lambda: unwrap_jointly(wrapped, extent=WIDTH))
    plain = least_seconds(lambda: numpy_unwrap(phases), 1)
    rows.append(("4 periods unwrapped jointly", both, None, plain, None))
    rows.append(("the whole phase set", ours + both, whole + plain, bare + plain, None))
    stack = gray_frames(pixels)
    frames = upload(stack, device="cpu")
    bits, inverses = list(range(BITS)), list(range(BITS, 2 * BITS))
    loop = stack[:, :LOOP_PIXELS]
    rows.append(("24 images, Gray code with inverses",
                 least_seconds(lambda: decode_gray(frames, bits, inverses, white=2 * BITS, black=2 * BITS + 1, extent=WIDTH, noise=NOISE)),
                 least_seconds(lambda: numpy_gray(stack, True)), least_seconds(lambda: numpy_gray(stack, False)),
                 least_seconds(lambda: loop_gray(loop), 1) * pixels / LOOP_PIXELS))

    def cell(seconds: float | None, ours: float | None = None) -> str:
        return "–" if seconds is None else f"{seconds:.3g}" + ("" if ours is None else f" ({seconds / ours:.1f}×)")

    return [f"{pixels / 1e6:g} megapixels, {devices.describe('cpu')}, seconds (in brackets over Relit's). `whole`: NumPy with the same "
            "uncertainty and status (unwrapping: without them); `bare`: NumPy without them. The Python loop is timed on fewer pixels and "
            "scaled.", "",
            "| | Relit | NumPy, whole | NumPy, bare | Python loop |", "|---|---|---|---|---|",
            *(f"| {name} | {cell(ours)} | {cell(whole, ours)} | {cell(bare, ours)} | {cell(looped, ours)} |"
              for name, ours, whole, bare, looped in rows)]


if __name__ == "__main__":
    print("\n".join(structured_rows(int(float(sys.argv[1]) * 1e6) if len(sys.argv) > 1 else PIXELS)))
