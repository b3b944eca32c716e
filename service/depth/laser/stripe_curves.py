"""Stripes of one frame as curves: which of them is the laser's, where a frame shows more than one.

A plane of light that the manifest declares gives one stripe. A second one on the same lines is a reflection, or a plane that nobody
declared. A reflection is fainter than what it reflects; of two stripes of comparable brightness nothing in the frame tells which one is
declared.
"""

from typing import NamedTuple

import numpy as np

from kernels.status import Status

PEAKS = 3
"""Stripes that are looked for on a line."""
RIVAL = 0.3
"""Brightness of a second stripe over that of the first, from which it may be a second laser: a diffuse wall that is lit by another one
returns less than a third of the other's light to any place."""
GHOST = 0.1
"""Brightness of a second stripe over that of the first, below which it may be a reflection that follows the stripe in every frame."""
LEAST_OVERLAP = 3
"""Lines on which two curves must lie side by side to be compared: a single line may hold a hot pixel."""
WHOLE = 1 / 3
"""Part of a curve beside which another one lies, from which all of it is in doubt; and the part of the lines of a frame from which all of
the frame is."""
STEP_PX = 4.0
"""Distance along the line up to which stripes on neighbouring lines are one curve: a slope of 76 degrees."""
GAP_LINES = 3
"""Lines without a stripe that a curve may cross: dark texture."""


class Chosen(NamedTuple):
    """The stripe of each line of a frame."""

    peak: np.ndarray  # [lines] int, which of the stripes found on the line
    status: np.ndarray  # [lines] uint8: as it was found, or MULTIPATH
    doubled: np.ndarray  # [lines] bool, where two stripes of comparable brightness lie side by side
    second: np.ndarray  # [lines] bool, where a second stripe of GHOST times the brightness or more lies beside the first
    curve: np.ndarray  # [lines] int, number of the curve of the stripe, -1 where there is none


def choose_curves(place: np.ndarray, brightness: np.ndarray, status: np.ndarray) -> Chosen:
    """Return the stripe to take on each line.
    `place`: [peaks, lines] float, continuous coordinates along the lines, the brightest first. `brightness`: [peaks, lines] float.
    `status`: [peaks, lines] uint8; those that are OK are stripes."""
    lines = place.shape[1]
    there = status == Status.OK
    several = there.sum(axis=0) > 1
    curve = link(place, there)
    if np.count_nonzero(several) < LEAST_OVERLAP:
        return Chosen(np.zeros(lines, int), status[0].copy(), np.zeros(lines, bool), np.zeros(lines, bool), curve[0])
    count = int(curve.max()) + 1
    length = np.bincount(curve[there], minlength=count)
    foreign, doubtful = np.zeros(count, bool), np.zeros(count, bool)
    doubled, second = np.zeros(lines, bool), np.zeros(lines, bool)
    comparable, unequal = [], []
    for one, other, at in _overlaps(curve, several):
        ratio = float(np.median(_of(brightness, curve, other, at) / np.maximum(_of(brightness, curve, one, at), 1e-30)))
        if RIVAL <= ratio <= 1 / RIVAL:
            comparable.append((one, other, at))
        else:
            foreign[other if ratio < RIVAL else one] = True
            unequal.append((one if ratio < RIVAL else other, at, GHOST <= ratio <= 1 / GHOST))
    for brighter, at, seen_well in unequal:
        second[at] |= seen_well and not foreign[brighter]
    for one, other, at in comparable:
        if not (foreign[one] or foreign[other]):  # two reflections say nothing of the stripe that they reflect
            doubled[at] = True
            for which in (one, other):
                doubtful[which] |= len(at) >= WHOLE * length[which]
    # of each line the brightest stripe that is no reflection of another
    mine = np.where(there, foreign[np.maximum(curve, 0)], True)
    peak = np.where(there[0], np.argmin(mine, axis=0), 0)
    at = np.arange(lines)
    found = status[peak, at].copy()
    doubt = doubled | np.where(there[peak, at], (foreign | doubtful)[np.maximum(curve[peak, at], 0)], False)
    seen = np.count_nonzero(there.any(axis=0))
    if np.count_nonzero(doubled) >= WHOLE * seen:
        doubt[:] = True
    found[doubt & (found == Status.OK)] = Status.MULTIPATH
    return Chosen(peak, found, doubled, second | doubled, curve[peak, at])


def link(place: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return the number of the curve of each stripe, [peaks, lines] int; -1 where there is no stripe.

    Stripes on neighbouring lines belong to one curve if each is the other's nearest; ends are then joined over gaps.
    """
    peaks, lines = place.shape
    before = np.full(peaks * lines, -1)
    taken_before, taken_after = np.zeros((peaks, lines), bool), np.zeros((peaks, lines), bool)
    for gap in range(1, GAP_LINES + 2):
        free_a, free_b = there[:, :-gap] & ~taken_after[:, :-gap], there[:, gap:] & ~taken_before[:, gap:]
        away = np.abs(place[:, None, :-gap] - place[None, :, gap:])
        away = np.where(free_a[:, None] & free_b[None] & (away <= STEP_PX * gap), away, np.inf)
        forward, backward = away.argmin(axis=1), away.argmin(axis=0)
        for a in range(peaks):
            at = np.arange(lines - gap)
            b = forward[a]
            joined = np.isfinite(away[a, b, at]) & (backward[b, at] == a)
            at, b = at[joined], b[joined]
            before[b * lines + at + gap] = a * lines + at
            taken_after[a, at], taken_before[b, at + gap] = True, True
    start = np.where(before < 0, np.arange(peaks * lines), before)
    while True:  # to where each chain begins: twice as far every round
        further = start[start]
        if (further == start).all():
            break
        start = further
    flat = there.reshape(-1)
    numbers = np.full(peaks * lines, -1)
    numbers[flat] = np.unique(start[flat], return_inverse=True)[1]
    return numbers.reshape(peaks, lines)


def _overlaps(curve: np.ndarray, several: np.ndarray) -> list[tuple[int, int, np.ndarray]]:
    """Return pairs of curves that lie side by side on LEAST_OVERLAP lines or more, and these lines."""
    found: dict[tuple[int, int], list[int]] = {}
    for line in np.flatnonzero(several):
        here = [int(number) for number in curve[:, line] if number >= 0]
        for index, one in enumerate(here):
            for other in here[index + 1:]:
                if one != other:
                    found.setdefault((min(one, other), max(one, other)), []).append(int(line))
    return [(one, other, np.array(at)) for (one, other), at in found.items() if len(at) >= LEAST_OVERLAP]


def _of(values: np.ndarray, curve: np.ndarray, number: int, at: np.ndarray) -> np.ndarray:
    return np.asarray(values[np.argmax(curve[:, at] == number, axis=0), at])
