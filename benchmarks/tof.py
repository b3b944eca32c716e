"""A 512x424 frame of nine images at three frequencies to filtered range: the kernels against vectorised NumPy in the same run.

    python -m benchmarks.tof
"""

import time
from collections.abc import Callable

import numpy as np
import warp as wp

from kernels.tof.continuous.bilateral import GUIDE_RELATIVE, LEAST_STEP, LEAST_VARIANCE, RANGE_SIGMAS, smooth
from kernels.tof.continuous.continuous import Noise, decode
from kernels.tof.continuous.decide import AGREEMENT_RAD, decide
from kernels.tof.continuous.modulation import common_range_m, radians_per_metre
from kernels.tof.continuous.unwrap import FLOOR_RAD, unwrap
from stage.tof.light_time import SPEED_OF_LIGHT
from tests.reference import tof as scenes

COLS, ROWS = 512, 424
HZ = (16e6, 80e6, 120e6)
RADIUS, SPATIAL = 2, 1.5
REPEATS = 15
SETTLE_S = 0.1
"""The seconds between NumPy and the kernels: BLAS threads keep a core busy for 40 ms more, which would count as time of the kernels."""


def kernels_work(images: np.ndarray, hz: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """Compute the range by the kernels, without the vote, which the NumPy side lacks too."""
    far = common_range_m(hz, SPEED_OF_LIGHT)
    found = decode(images, hz, delta, noise=Noise(1.0, 5.0), device="cpu")
    ranges = decide(found, unwrap(found, nearest_m=0.0, farthest_m=far, light_speed=SPEED_OF_LIGHT), light_speed=SPEED_OF_LIGHT)
    guide = wp.array(found.amplitude.numpy().mean(axis=0), device="cpu")
    return smooth(ranges.range, ranges.sigma, guide, ranges.status, ROWS, COLS, radius=RADIUS, spatial_px=SPATIAL).range.numpy()


def numpy_work(images: np.ndarray, hz: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """Compute the same range in NumPy, in float32, with each step over the whole image."""
    f32 = np.float32
    frequencies = np.unique(hz)
    phase, sigma, amplitude, evidence = [], [], [], []
    for frequency in frequencies:
        mine = hz == frequency
        matrix = np.stack([np.ones(mine.sum()), np.cos(delta[mine]), np.sin(delta[mine])], axis=1)
        rows = np.linalg.pinv(matrix).astype(f32)
        y = images[mine]
        _, a, b = rows @ y
        variance = f32(25.0) + np.maximum(y, 0)
        aa, ab, bb = (rows[i] * rows[j] @ variance for i, j in ((1, 1), (1, 2), (2, 2)))
        q2 = a * a + b * b
        phase.append(np.mod(np.arctan2(b, a), f32(2 * np.pi)))
        sigma.append(np.sqrt((b * b * aa - 2 * a * b * ab + a * a * bb) / q2 / q2))
        amplitude.append(np.sqrt(q2))
        evidence.append(2 * q2 / (aa + bb))
    per_metre = radians_per_metre(frequencies, SPEED_OF_LIGHT).astype(f32)
    weight = [1 / (s * s + f32(FLOOR_RAD**2)) for s in sigma]
    total = sum(w * k * k for w, k in zip(weight, per_metre, strict=True))
    wave, far = 2 * np.pi / float(per_metre[-1]), common_range_m(hz, SPEED_OF_LIGHT)
    best, best_cost = np.zeros_like(phase[0]), np.full_like(phase[0], np.inf)
    for n in range(-1, int(np.ceil(far / wave)) + 1):
        d = phase[-1] / per_metre[-1] + f32(n * wave)
        moved, cost = np.zeros_like(d), np.zeros_like(d)
        for p, w, k in zip(phase, weight, per_metre, strict=True):
            turns = (p - k * d) * f32(1 / (2 * np.pi))
            away = (turns - np.round(turns)) * f32(2 * np.pi)
            moved += w * k * away
            cost += w * away * away
        cost -= moved * moved / total
        d += moved / total
        take = (cost < best_cost) & (d >= 0) & (d <= far)
        best, best_cost = np.where(take, d, best), np.where(take, cost, best_cost)
    agree = np.zeros_like(best)
    for p, s, k in zip(phase, sigma, per_metre, strict=True):
        turns = (p - k * best) * f32(1 / (2 * np.pi))
        away = (turns - np.round(turns)) * f32(2 * np.pi)
        agree += away * away / (s * s + f32(AGREEMENT_RAD**2))
    ok = ((sum(evidence) > 38) & (agree < 18.4)).reshape(ROWS, COLS)
    return numpy_bilateral(best.reshape(ROWS, COLS), np.sqrt(1 / total).reshape(ROWS, COLS),
                           (sum(amplitude) / f32(len(amplitude))).reshape(ROWS, COLS), ok).reshape(-1)


def numpy_bilateral(d: np.ndarray, sigma: np.ndarray, guide: np.ndarray, ok: np.ndarray) -> np.ndarray:
    """Fit a weighted plane in each window, one shift of the whole image at a time."""
    f32 = np.float32
    v = np.where(ok, sigma * sigma + f32(LEAST_VARIANCE), f32(np.inf))
    pad = RADIUS
    padded = [np.pad(x, pad, constant_values=fill) for x, fill in ((d, 0), (v, np.inf), (guide, 1))]
    m = [np.zeros_like(d) for _ in range(6)]
    t = [np.zeros_like(d) for _ in range(3)]
    s2, step2 = sigma * sigma, (f32(LEAST_STEP) * d) ** 2
    for y in range(-pad, pad + 1):
        for x in range(-pad, pad + 1):
            dq, vq, gq = (p[pad + y : pad + y + ROWS, pad + x : pad + x + COLS] for p in padded)
            away = dq - d
            ratio = (gq - guide) / (f32(GUIDE_RELATIVE) * np.maximum(gq, guide))
            finite = np.where(np.isfinite(vq), vq, 0)
            unlike = ratio * ratio + away * away / (f32(RANGE_SIGMAS**2) * (finite + s2) + step2)
            w = f32(np.exp(-0.5 * (x * x + y * y) / SPATIAL**2)) * np.exp(-0.5 * unlike) / vq
            for target, factor in zip(m, (1, x, y, x * x, x * y, y * y), strict=True):
                target += w * f32(factor)
            for target, factor in zip(t, (1, x, y), strict=True):
                target += w * away * f32(factor)
    a = m[3] * m[5] - m[4] * m[4]
    b = m[2] * m[4] - m[1] * m[5]
    e = m[1] * m[4] - m[2] * m[3]
    with np.errstate(invalid="ignore", divide="ignore"):
        found = d + (a * t[0] + b * t[1] + e * t[2]) / (m[0] * a + m[1] * b + m[2] * e)
    return np.where(ok & np.isfinite(found), found, d)


def _seconds(work: Callable[..., object], *arguments: np.ndarray) -> float:
    began = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - began


def _pair(*arguments: np.ndarray) -> tuple[float, float]:
    time.sleep(SETTLE_S)
    return _seconds(kernels_work, *arguments), _seconds(numpy_work, *arguments)


def rows() -> list[str]:
    """Return the table as lines of Markdown."""
    view = scenes.room(ROWS, COLS)
    settings = scenes.even(HZ, 3)
    images = scenes.correlations(view, 1e5, settings, seed=0).reshape(len(settings), -1).astype(np.float32)
    hz, delta = (np.array(column) for column in zip(*settings, strict=True))
    ours, theirs = kernels_work(images, hz, delta), numpy_work(images, hz, delta)
    truth = view.distance.reshape(-1)
    pairs = np.array([_pair(images, hz, delta) for _ in range(REPEATS)])
    fast, slow = np.median(pairs, axis=0)  # taken in turns: what else the machine does hits both
    return [f"Time of flight, {COLS}x{ROWS}, nine images at three frequencies: phases, wraps and joint bilateral filter, on the CPU:", "",
            "| | ms a frame | median error, mm |", "|---|---|---|",
            f"| kernels | {1e3 * fast:.1f} | {1e3 * np.median(np.abs(ours - truth)):.2f} |",
            f"| the same in vectorised NumPy | {1e3 * slow:.1f} | {1e3 * np.median(np.abs(theirs - truth)):.2f} |",
            f"| ratio | {slow / fast:.1f} | |"]


if __name__ == "__main__":
    print("\n".join(rows()))
