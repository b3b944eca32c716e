"""Orders in which the frames of waves may have been taken otherwise than they are declared: steps, periods, and the loop of both.

The readings of a pixel over the steps of all periods are one mean, and a cosine and a sine of each period. What these leave of the readings
is noise in the right order, and as large as the waves in another one; no calibration and no smooth surface is needed to tell.
"""

from collections.abc import Iterator
from itertools import combinations, permutations

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import weights
from service.depth.patterns.pattern_checks import ENOUGH, Sample
from service.depth.patterns.response_checks import LEAST_TURN_BINS, TURN_BINS
from stage.patterns.codes import Collected
from stage.patterns.phase import FULL_STEPS, PhaseCode

CONTRADICTED = 3.0
"""Mean square of what waves leave of the readings, in variances of noise, above which other orders are tried."""
LEFT = 0.3
"""Part of it that another order may leave, to be named: orders that are as wrong leave all of it, and noise and harmonics a quarter."""
STEPS_OF_HARMONIC = 4
"""Steps of a period from which on, for each of its harmonics, that harmonic is part of the wave: a projector that bends waves has it."""
ALIKE = 1.05
"""Orders that leave up to this many times the least are named too: of four steps, 1 and 2 exchanged look like 0 and 3 exchanged."""
SOME = 1000
"""Number of pixels that are compared."""
ALL_ORDERS = 4
"""Most periods of which all orders are tried; of more, two exchanged ones and the reversed order."""


def other_orders(periods: np.ndarray) -> Iterator[tuple[np.ndarray, str]]:
    """Yield the periods of waves in other orders, and the words that name them."""
    count = range(len(periods))
    orders = set(permutations(count)) if len(periods) <= ALL_ORDERS else {tuple(reversed(count))}
    for first, second in combinations(count, 2):
        exchanged = list(count)
        exchanged[first], exchanged[second] = second, first
        orders.add(tuple(exchanged))
    for order in sorted(orders - {tuple(count)}):
        other = periods[list(order)]
        listed = ", ".join(f"{period:g}" for period in other)
        yield other, f"fit each other if their periods are {listed} px, in the order of the images: check period_px"


def check_order(sample: Sample, collected: Collected, noise: NoiseModel) -> str | None:
    """Return a sentence if the frames of a code are far better waves in another order than in the declared one."""
    grey = sample.grey
    lit = np.flatnonzero(sample.lit(grey, noise))
    if len(lit) < ENOUGH:
        return None
    lit = lit[:: max(1, len(lit) // SOME)]
    for code in collected.codes:
        if isinstance(code, PhaseCode) and (words := _other_order(code, grey[:, lit].astype(np.float64), noise)) is not None:
            return f"frames: the {code.axis} phases are waves if {words}"
    return None


def _other_order(code: PhaseCode, grey: np.ndarray, noise: NoiseModel) -> str | None:
    """Return the words of the order in which readings [frames, pixels] are waves; None if they are so as declared, or in no order."""
    waves = [sorted(zip(wave.frames, wave.shifts, strict=True)) for wave in code.waves]
    named = [[round(shift * len(wave)) for _, shift in wave] for wave in waves]
    roles = [frame for wave in waves for frame, _ in wave]
    left_over = _without_waves(code, len(grey))[roles][:, roles]
    free, steps = round(float(np.trace(left_over))), len(waves[0])
    if free < 1 or steps < FULL_STEPS or any(other != named[0] for other in named):
        return None
    readings = grey[roles]
    variance = noise.variance(readings.mean(axis=0))

    def left(order: np.ndarray, over: np.ndarray = left_over) -> float:
        return float(np.median(((over @ readings[order.ravel()]) ** 2).sum(axis=0) / variance) / free)

    declared = np.arange(len(roles)).reshape(len(waves), steps)
    before = left(declared)
    if before < CONTRADICTED:
        return None
    found = []
    for first, second in combinations(range(steps), 2):
        order = declared.copy()
        order[:, [first, second]] = declared[:, [second, first]]
        found.append((left(order), " and ".join(map(str, sorted((named[0][first], named[0][second]))))))
    exchanges = len(found)
    _, along, across = weights(np.array(code.waves[0].shifts), code.waves[0].period_px).T @ grey[list(code.waves[0].frames)]
    seen = len(np.unique(np.floor(np.arctan2(across, along) / (2 * np.pi) * TURN_BINS))) >= LEAST_TURN_BINS
    for other in (steps - 1, steps + 1) if seen else ():  # both ends of a period, and all steps but the last
        over = _without_waves(code, len(grey), steps / other)[roles][:, roles]
        found.append((left(declared, over), f"a step is 1/{other} of a period: check step and steps in the frames' patterns"))
    taken = np.argsort(np.argsort(roles))  # place of each frame in the sequence
    across = declared.reshape(steps, len(waves)).T
    words = "all {} come before the next {}: check the order of the images (--order axis,{} of relit import phase)"
    if len(waves) > 1 and (taken == declared.ravel()).all():
        found.append((left(across), words.format("periods of one step", "step", "step,period")))
    elif len(waves) > 1 and (taken == across.ravel()).all():
        found.append((left(np.argsort(taken).reshape(declared.shape)), words.format("steps of one period", "period", "period,step")))
    best = min(found)[0]
    if best > LEFT * before:
        return None
    exchanged, others = ([text for part, text in some if part <= ALIKE * best] for some in (found[:exchanges], found[exchanges:]))
    if exchanged:
        others.insert(0, f"the steps {' or '.join(exchanged)} are exchanged: check step in the frames' patterns")
    return ", or if ".join(others)


def _without_waves(code: PhaseCode, frames: int, times: float = 1.0) -> np.ndarray:
    """Return the matrix [frames, frames] that leaves of readings what no mean and no wave explains; with steps so many `times` as wide."""
    parts = [np.zeros(frames)]
    for wave in code.waves:
        at, turns = list(wave.frames), 2 * np.pi * times * np.array(wave.shifts)
        parts[0][at] = 1.0
        for harmonic in range(1, 1 + max(1, len(at) // STEPS_OF_HARMONIC)):
            for shape in (np.cos(harmonic * turns), np.sin(harmonic * turns)):
                parts.append(np.zeros(frames))
                parts[-1][at] = shape
    whole = np.stack(parts, axis=1)
    return np.eye(frames) - whole @ np.linalg.pinv(whole)
