"""Checks of what the phases of a continuous-wave camera are declared to be: how they change over surfaces, and how bright these are.

Over a surface every phase changes in proportion to its frequency, whatever its wraps and its zero are; so frequencies that are declared
wrongly show in the changes between neighbours. Phases that run backwards turn the scene inside out: each surface then grows brighter with
the distance, where light falls off with its square. Both are only looked for; a reading is named where it fits and the declared one does
not.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.tof.continuous.continuous import LEAST_PHASES, Correlation, Noise, weights

LAG = 3
"""Distance in pixels of the neighbours that are compared: a surface changes over it by more than noise."""
LARGEST_RAD = 0.7
"""Largest change of a phase between them; a larger one is an edge."""
CLEAR_SIGMAS = 5.0
"""Least change of the phase that others are compared with, in its standard deviations: noise then hardly dilutes their ratio."""
ENOUGH = 200
"""Number of neighbours that tell a ratio, and of pixels that tell what an image shows."""
AGREE, CLEAR_SHARE, CLEAR_TIMES = 0.5, 0.85, 2.0
"""Share of the pixels whose frequencies agree, from which on the frequencies are not doubted; least share with which another reading is
named, and how many times that of the declared one it must be."""
AS_GOOD = 0.02
"""Share of the pixels by which one reading may be worse than another and still be named in its place."""
STEP_HZ, UNSURE_RATIO = 1e6, 0.04
"""Steps of the frequencies that are tried, and the part by which changes of phases leave their ratio open: wiggling and edges bend it."""
NARROW = 0.995
"""Mean of the unit vectors of a phase from which on it spans too little, a third of a radian: there wiggling makes any ratio."""
BLOCKS = 12
"""Number of blocks in each direction of an image in which the brightness is compared with the range."""
IN_A_BLOCK = 20
"""Number of neighbours that tell it in a block."""
EDGE_PART, FALL_OFF = 0.05, 0.35
"""Largest change of the range, as a part of it, and of the logarithm of the brightness, between neighbours of one surface."""
STEEPEST, FLATTEST = -4.0, -1.0
"""Powers of the distance with which light falls: -2 where surfaces face the camera, -3 over a plane, and 1 on either side for bends and
textures."""
SURE_BLOCK, MOST_BLOCKS, LAWFUL_BLOCKS, FEWEST_BLOCKS = 0.3, 0.7, 0.6, 20
"""Least correlation of brightness and range in a block that tells a sign, share of such blocks in which surfaces grow brighter with the
distance and share of these in which the brightness falls as light does if ranges run backwards, from which on they do, and number of blocks
that tell it. Bowls and hollows with bright paint have 0.45 of lawful blocks at most, rooms 0.74 at least."""
UNFIT_TIMES, UNFIT_PART = 4.0, 0.2
"""Variance that the wave of a frequency leaves of its images, over that of their neighbours in a row, and its root over the amplitude, from
which on an image is not that of its phase."""
UNFIT_SIGMAS, UNFIT_PIXEL = 6.0, 0.1
"""What a wave leaves of the readings of a frequency at a pixel, over its noise and over the amplitude, from which on they are not those
of one wave."""
END_PART, FEWEST_WRAPPED, WRAPPED_SHARE = 0.03, 20, 1e-4
"""Largest distance of neighbours over an end of the span, as a part of it, and number of such neighbours and their share of the pixels,
from which on a surface runs on behind the span."""
PHASES_REPEAT = "modulation_hz", ("all phases repeat: they are farther than the frequencies tell apart; give --near-m, or add a "
                                  "frequency")
HISTOGRAM_REPEATS = "bin_s", ("the histogram begins again: they are farther than a period of the laser reaches; let it pulse more "
                              "seldom, or turn the bins so that the nearest surface comes first, with their tof.start_s")
"""What repeats, and what to do, as `beyond_span` says it."""
FULL, HEAPED = 20, 5.0
"""Number of readings of each of two images that are the largest of all, and how many times as many they must be as are of each level of the
tenth below, from which on a camera was full there: noise gives the largest to one, and an even wall to one image."""
DOUBTED = 0.1
"""Factor on the probability of ranges whose frames are declared wrongly."""


def full_at(images: np.ndarray) -> float | None:
    """Return the reading at which a camera was full, of [images, pixels] readings; None if they show none."""
    top = images.max(initial=0)
    if not top > 0 or ((images == top).sum(axis=1) >= FULL).sum() < 2:
        return None
    _, counts = np.unique(images[images >= 0.9 * top], return_counts=True)
    return float(top) if counts[-1] >= HEAPED * counts[:-1].sum() / max(len(counts) - 1, 1) else None


class Phases(NamedTuple):
    """Phases of a whole image, ascending in frequency."""

    phase: np.ndarray  # [F, rows, cols] radians
    sigma: np.ndarray  # [F, rows, cols] radians, not above 0 where there is none
    hz: np.ndarray  # [F]

    def changed(self, hz: np.ndarray, sign: np.ndarray) -> "Phases":
        """Return what they are if they belong to other frequencies, and run backwards where the sign is -1."""
        order = np.argsort(hz)
        return Phases((self.phase * sign[:, None, None] % (2 * np.pi))[order], self.sigma[order], hz[order])


def misread_frequencies(phases: Phases, declared: float, agreeing: Callable[[Phases], float],
                        others: Iterable[tuple[Phases, str]]) -> str | None:
    """Return how frequencies are declared wrongly, as a sentence; None if none is, or no other reading fits.
    `declared`: share of the pixels whose frequencies agree as declared. `agreeing`: of other phases. `others`: further readings, each with
    what to check."""
    if declared >= AGREE or len(phases.hz) < 2:
        return None
    tried = [(agreeing(other), words) for other, words in (*_readings(phases), *others)]
    best, words = next(found for found in tried if found[0] >= max(tried)[0] - AS_GOOD)  # exchanged ones come first
    if best < max(CLEAR_SHARE, CLEAR_TIMES * declared):
        return None
    return (f"frames[].tof: as declared, the frequencies agree at {100 * declared:.0f} % of the pixels, and at {100 * best:.0f} % if "
            f"{words}; no range is believed")


def _readings(phases: Phases) -> Iterator[tuple[Phases, str]]:
    """Yield other ways to understand the phases of several frequencies, and what to check."""
    hz, same = phases.hz, np.ones(len(phases.hz))
    for quarters, words in enumerate(("a quarter", "half", "three quarters"), start=1):
        yield (phases._replace(phase=(phases.phase + quarters * np.pi / 2) % (2 * np.pi)),
               f"reference_phase_rad is {words} of a turn more: check it, the order of the images, and their sign")
    for a, b in combinations(range(len(hz)), 2):
        swapped = hz.copy()
        swapped[[a, b]] = hz[[b, a]]
        yield phases.changed(swapped, same), f"{hz[a] / 1e6:g} and {hz[b] / 1e6:g} MHz are exchanged: check modulation_hz"
    seen: set[tuple[int, float]] = set()
    spans = [abs(np.exp(1j * phase[sigma > 0]).mean()) < NARROW if (sigma > 0).any() else False
             for phase, sigma in zip(phases.phase, phases.sigma, strict=True)]
    for known, other in permutations(range(len(hz)), 2):
        ratio = _ratio(phases, other, known) if spans[known] and spans[other] else None
        if ratio is None:
            continue
        least, most = (round((1 + part) * abs(ratio) * hz[known] / STEP_HZ) for part in (-UNSURE_RATIO, UNSURE_RATIO))
        for step in range(max(least, 1), most + 1):
            found, sign = hz.copy(), same.copy()
            found[other], sign[other] = step * STEP_HZ, np.sign(ratio)
            reading = other, float(sign[other] * found[other])
            if len(set(found)) == len(found) and reading not in {*seen, (other, float(hz[other]))}:
                seen.add(reading)
                yield phases.changed(found, sign), _words(hz[other], found[other], backwards=ratio < 0)


def _words(declared_hz: float, found_hz: float, *, backwards: bool) -> str:
    declared = f"{declared_hz / 1e6:g} MHz"
    what = [f"{declared} are {found_hz / 1e6:g} MHz: check modulation_hz"] if found_hz != declared_hz else []
    return " and ".join([*what, f"the phases of {declared} run backwards: check reference_phase_rad and the "
                               "order of the images"] if backwards else what)


def _ratio(phases: Phases, one: int, other: int) -> float | None:
    """Return how many times as fast one phase changes over surfaces as another; None if too few neighbours tell it. The slower is divided
    by the faster: noise of what is divided by makes a ratio too small (120 MHz were 6.4 times 16)."""
    over = _divided(phases, one, other)
    if over is not None and abs(over) <= 1:
        return over
    under = _divided(phases, other, one)
    return 1 / under if under else over


def _divided(phases: Phases, one: int, other: int) -> float | None:
    """Return the median change of one phase over surfaces in that of another; None if too few neighbours tell it."""
    first: list[np.ndarray] = []
    second: list[np.ndarray] = []
    for axis in (0, 1):
        step = [_between(phases.phase[f], axis) for f in (one, other)]
        spread = [np.hypot(*_ends(phases.sigma[f], axis)) for f in (one, other)]
        known = np.logical_and.reduce([(side > 0) for f in (one, other) for side in _ends(phases.sigma[f], axis)])
        kept = known & (np.abs(step[0]) < LARGEST_RAD) & (np.abs(step[1]) < LARGEST_RAD) & (np.abs(step[1]) > CLEAR_SIGMAS * spread[1])
        first.append(step[0][kept])
        second.append(step[1][kept])
    changes, reference = np.concatenate(first), np.concatenate(second)
    if len(changes) < ENOUGH:
        return None
    ratio = changes / reference
    order = np.argsort(ratio)
    weight = np.cumsum(np.abs(reference)[order])
    return float(ratio[order][np.searchsorted(weight, weight[-1] / 2)])


def _ends(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of both pixels of each pair LAG apart."""
    return (values[LAG:], values[:-LAG]) if axis == 0 else (values[:, LAG:], values[:, :-LAG])


def _between(phase: np.ndarray, axis: int) -> np.ndarray:
    """Return the change of a phase over LAG pixels, -π…π."""
    there, here = _ends(phase, axis)
    return (there - here + np.pi) % (2 * np.pi) - np.pi


def misread_direction(range_m: np.ndarray, reversed_m: np.ndarray, amplitude: np.ndarray, sure: np.ndarray) -> str | None:
    """Return how the brightness of surfaces tells that ranges run backwards, in words; None if light does not fall off more rightly so.

    That surfaces grow brighter with the distance is not enough: the walls of a bowl do, and paint that is bright behind. If the ranges run
    backwards the brightness follows the true distances, and falls with these as light does.

    Source: Horn, "Obtaining shape from shading information", 1975: under a source at the camera, a plane's light falls with the cube of the
    distance.

    Args:
        range_m, reversed_m: [rows, cols] metres, as declared and if ranges run backwards.
        amplitude: [rows, cols], in any unit.
        sure: [rows, cols] bool, pixels with a range.
    """
    rows, cols = range_m.shape
    lit = sure & (amplitude > 0) & (range_m > 0) & (reversed_m > 0)
    near, far, bright = (np.log(np.where(lit, values, 1.0)) for values in (range_m, reversed_m, amplitude))
    square, mixed, other, true_square, true_mixed, count = (np.zeros((BLOCKS, BLOCKS)) for _ in range(6))
    for axis in (0, 1):
        step, true_step, change = (np.subtract(*_ends(values, axis)) for values in (near, far, bright))
        both = np.logical_and(*_ends(lit, axis)) & (np.maximum(np.abs(step), np.abs(true_step)) < EDGE_PART) & (np.abs(change) < FALL_OFF)
        line, place = np.nonzero(both)
        block = (line * BLOCKS // rows, place * BLOCKS // cols)
        for total, values in ((square, step * step), (mixed, step * change), (other, change * change), (count, np.ones_like(step)),
                              (true_square, true_step * true_step), (true_mixed, true_step * change)):
            np.add.at(total, block, values[both])
    part = mixed / np.sqrt(np.maximum(square * other, 1e-30))
    power = true_mixed / np.maximum(true_square, 1e-30)
    tells = (count >= IN_A_BLOCK) & (np.abs(part) >= SURE_BLOCK)
    brighter = tells & (part > 0)
    share = float(brighter.sum() / tells.sum()) if tells.sum() >= FEWEST_BLOCKS else 0.0
    if share < MOST_BLOCKS or ((power >= STEEPEST) & (power <= FLATTEST))[brighter].mean() < LAWFUL_BLOCKS:
        return None
    return f"in {100 * share:.0f} % of the scene surfaces grow brighter with the distance"


def unfitting_images(images: np.ndarray, hz: np.ndarray, reference_phase_rad: np.ndarray, scale: np.ndarray,
                     usable: np.ndarray) -> str | None:
    """Return that images of a frequency are no wave over their phases, as a sentence: one is dark, shown twice or another's; None where all
    are, or where a frequency has three images, which any wave fits.

    Args:
        images: [images, rows · cols] recorded values.
        hz, reference_phase_rad, scale: [images], as `kernels.tof.continuous.continuous.weights` takes them.
        usable: [rows, cols] bool.
    """
    rows, frequencies, index = weights(hz, reference_phase_rad, scale)
    triples = usable[:, 2:] & usable[:, 1:-1] & usable[:, :-2]
    if not triples.any():
        return None
    for number, frequency in enumerate(frequencies):
        own = index == number
        if own.sum() <= LEAST_PHASES:
            continue
        mine = images[own].astype(np.float64) * scale[own, None]
        fit = rows[own].T @ images[own]
        delta = reference_phase_rad[own, None]
        left = ((mine - fit[0] - fit[1] * np.cos(delta) - fit[2] * np.sin(delta)) ** 2).sum(axis=0) / (own.sum() - LEAST_PHASES)
        grid = mine.reshape(-1, *usable.shape)
        bend = (grid[..., 2:] - 2 * grid[..., 1:-1] + grid[..., :-2])[:, triples]
        unfit, noise = np.median(left[usable.ravel()]), np.median(bend**2) / 6
        if unfit > UNFIT_TIMES * noise and unfit > UNFIT_PART**2 * np.median((fit[1] ** 2 + fit[2] ** 2)[usable.ravel()]):
            return (f"frames[].tof: the images of {frequency / 1e6:g} MHz are no wave over their phases: one of them may be dark, shown "
                    "twice or exchanged; check image and reference_phase_rad; no range is believed")
    return None


def unfitting_pixels(found: Correlation, noise: Noise, pixels: int) -> np.ndarray:
    """Return where the readings of a frequency with four images or more are no wave over their phases, as where rows of an image were lost,
    or something moved between two images: [pixels] bool."""
    residual, amplitude, offset = (to_numpy(values)[:, :pixels] for values in (found.residual, found.amplitude, found.offset))
    freedom = found.freedom[:, None]
    variance = noise.read**2 + noise.shot * np.maximum(offset, 0)
    least = np.maximum(UNFIT_SIGMAS**2 * variance, (UNFIT_PIXEL * amplitude) ** 2)
    return np.asarray(((freedom > 0) & (residual > freedom * least)).any(axis=0))


def beyond_span(range_m: np.ndarray, sure: np.ndarray, *, nearest_m: float, repeat_m: float, why: tuple[str, str] = PHASES_REPEAT
                ) -> str | None:
    """Return that surfaces run on behind the farthest range and so appear before the nearest, as a sentence; None if none does.

    Args:
        range_m: [rows, cols] metres, searched over all of the span.
        sure: [rows, cols] bool, pixels with a range.
        nearest_m, repeat_m: the least range, and the distance after which all phases repeat, or the histogram does.
        why: the field of the manifest, and what repeats there with what to do.
    """
    part = (range_m - nearest_m) / repeat_m
    wrapped = 0
    for axis in (0, 1):
        step = np.abs(np.diff(part, axis=axis))
        both = sure[1:] & sure[:-1] if axis == 0 else sure[:, 1:] & sure[:, :-1]
        wrapped += int((both & (np.abs(1 - step) < END_PART)).sum())
    if wrapped < max(FEWEST_WRAPPED, WRAPPED_SHARE * sure.sum()):
        return None
    return (f"frames[].tof.{why[0]}: surfaces run on from {nearest_m + repeat_m:.2f} m to {nearest_m:.2f} m, where {why[1]}; no range is "
            "believed")
