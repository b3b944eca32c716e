"""Polarised pairs that the images contradict: swapped, shifted against each other, or under a light that changed; and how much leaks.

A parallel-polarised image is nowhere darker than the cross-polarised one of the same light, except by noise. Noise is measured on the
difference of the two, in which the texture of a pair that fits has gone. How far one is shifted against the other is what makes the
fine structure of the cross-polarised image explain that of the difference (Lucas and Kanade 1981).
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import some_of
from stage.spread import MAD_TO_SIGMA
from stage.stack.stack import Stack

PIXELS = 8192
"""Pixels, spread over the object, at which the brightness of pairs is compared."""
BLOCK = 160
"""Side in pixels of the part of the image in which fine structure is compared."""
NOISE_SIGMAS, DRIFT = 5.0, 0.03
"""A reading counts as darker beyond so many standard deviations of noise and this part of the brightness, by which lights may flicker."""
LEAST_DARKER, DARKER_PART = 8, 0.002
"""Least count and least part of the pixels that are darker in a pair that is swapped."""
MOVED_PART = 0.02
"""Part of the pixels that are darker from which a pair does not fit."""
SWAPPED_TIMES = 3.0
"""Least ratio of darker to brighter pixels in a pair that is swapped."""
LARGEST_SHIFT, SHIFT_SIGMAS = 0.5, 8.0
"""Shift in pixels of a pair that does not fit, and how many standard errors it is at least."""
LEAST_PERCENT, FALLING_PART = 10.0, 0.7
"""A shift is believed if, among this percentage of the pixels, those that it makes darkest, more than this part is darker; noise makes it
one half."""
SCALES = (1.0, 4.0)
"""Standard deviations in pixels of the blurs at which shifts are looked for: the wider shows shifts of several pixels."""
BINS = 4
"""Parts of equal count, by brightness, of which noise is measured."""
LEAK_ERROR, LEAK_PERCENTILE, LEAK_SIGMAS = 0.01, 1.0, 3.0
"""Largest standard error of a pixel's share of crossed light that bounds the leak; which percentile of these shares is taken; and how many
standard errors are added to it."""


class PairFindings(NamedTuple):
    """Result of checking the pairs of a capture against the images."""

    fault: str | None
    """A sentence about the first pair that does not fit, without the name of the manifest; None: all fit."""
    leak_at_most: float | None
    """The largest leak that no reading contradicts; None: no reading is bright enough."""
    noise: float
    """Standard deviation of the difference of a pair, over the brightness of the pair: median over the readings."""


def examine_pairs(cross: Stack, parallel: Stack, partners: list[tuple[str, str]], mask: np.ndarray) -> PairFindings:
    """Compare the cross-polarised and the parallel-polarised image of every light, whose names are `partners`, over the mask."""
    block = _block(mask)
    spread = some_of(mask, PIXELS)
    crossed, along, usable = _grey(cross, parallel, spread)
    near_crossed, near_along, near_usable = _grey(cross, parallel, block.reshape(-1))
    noises, fault = [], None
    crossed_sum, whole_sum, variance = (np.zeros(len(spread)) for _ in range(3))
    for light, (name, partner) in enumerate(partners):
        shape = block.shape
        fine = _Noise.of(near_crossed[light].reshape(shape), near_along[light].reshape(shape), near_usable[light].reshape(shape))
        used = usable[light]
        c, p = crossed[light][used], along[light][used]
        sigma = fine.at(c + p)
        noises.append(np.median(sigma / np.maximum(c + p, 1e-12)) if len(c) else 0.0)
        crossed_sum[used] += c
        whole_sum[used] += c + p
        variance[used] += sigma**2 / 2
        if fault is None:
            fault = _fault(name, partner, c, p, sigma)
        if fault is None:
            shift = _shift(near_crossed[light].reshape(shape), near_along[light].reshape(shape), near_usable[light].reshape(shape))
            if shift > LARGEST_SHIFT:
                fault = (f"{partner} is shifted against {name} by {shift:.1f} pixels: camera and subject must stand still between the two "
                         "images of a pair")
    return PairFindings(fault, _leak_bound(crossed_sum, whole_sum, variance), float(np.median(noises)))


def _leak_bound(crossed: np.ndarray, whole: np.ndarray, variance: np.ndarray) -> float | None:
    """Return the largest leak that the light of no pixel contradicts: of C and C + P, summed over the lights, C is at least that part."""
    error = np.sqrt(variance) / np.maximum(whole, 1e-12)
    told = (whole > 0) & (error < LEAK_ERROR)
    if np.count_nonzero(told) < LEAST_DARKER:
        return None
    shares = crossed[told] / whole[told]
    return max(0.0, float(np.percentile(shares, LEAK_PERCENTILE) + LEAK_SIGMAS * np.median(error[told])))


class _Noise(NamedTuple):
    """Standard deviation of the difference of a pair by the brightness of the pair."""

    brightness: np.ndarray  # [bins], increasing
    sigma: np.ndarray  # [bins]

    @classmethod
    def of(cls, crossed: np.ndarray, along: np.ndarray, usable: np.ndarray) -> "_Noise":
        """Measure the noise on second differences of neighbours, [rows, cols] each."""
        difference = along - crossed
        second = (difference[:, 1:-1] - (difference[:, :-2] + difference[:, 2:]) / 2) / np.sqrt(1.5)
        kept = usable[:, 1:-1] & usable[:, :-2] & usable[:, 2:]
        brightness, second = (crossed + along)[:, 1:-1][kept], np.abs(second[kept])
        if len(second) < BINS:
            return cls(np.zeros(1), np.zeros(1))
        parts = np.array_split(np.argsort(brightness), BINS)
        return cls(np.array([brightness[part].mean() for part in parts]),
                   np.array([MAD_TO_SIGMA * np.median(second[part]) for part in parts]))

    def at(self, brightness: np.ndarray) -> np.ndarray:
        """Return the standard deviation at a brightness; above the brightest bin it grows as its square root, as photon noise does."""
        above = np.sqrt(np.maximum(brightness / max(float(self.brightness[-1]), 1e-12), 1))
        return np.asarray(np.interp(brightness, self.brightness, self.sigma) * above)


def _fault(name: str, partner: str, crossed: np.ndarray, along: np.ndarray, sigma: np.ndarray) -> str | None:
    """Return a sentence where the parallel image of a pair is darker than the cross one."""
    limit = NOISE_SIGMAS * sigma + DRIFT * np.abs(crossed + along)
    darker, brighter = (int(np.count_nonzero(sign * (along - crossed) > limit)) for sign in (-1, 1))
    part = darker / max(len(crossed), 1)
    if darker >= max(LEAST_DARKER, DARKER_PART * len(crossed)) and darker > SWAPPED_TIMES * brighter:
        return (f"{partner} is polarised parallel and darker than {name}, which is crossed, in {100 * part:.1f} % of the pixels and "
                f"brighter in {100 * brighter / len(crossed):.1f} %: the two are swapped")
    if part > MOVED_PART:
        return (f"{partner} is polarised parallel and darker than {name}, which is crossed, in {100 * part:.1f} % of the pixels: something "
                "moved, or the light changed between them")
    return None


def _shift(crossed: np.ndarray, along: np.ndarray, usable: np.ndarray) -> float:
    """Return by how many pixels fine structure is shifted, 0 where that is not sure."""
    largest = 0.0
    for width in SCALES:
        whole = _blurred((~usable).astype(np.float64), 2 * width) < 1e-6  # no reading is lost nearby
        if np.count_nonzero(whole) < 10 * BINS:
            continue
        first, second = (_blurred(image, width) - _blurred(image, 2 * width) for image in (crossed, along))
        down, right = np.gradient(first)
        columns = np.stack([first[whole], right[whole], down[whole]], axis=1)
        difference = (second - first)[whole]
        weight = np.ones(len(difference))
        for _ in range(8):
            normal = columns.T @ (weight[:, None] * columns)
            if np.linalg.cond(normal) > 1e10:
                break
            found = np.linalg.solve(normal, columns.T @ (weight * difference))
            off = difference - columns @ found
            spread = max(MAD_TO_SIGMA * float(np.median(np.abs(off))), 1e-12)
            weight = 1 / (1 + (off / (2 * spread)) ** 2)
        else:
            # neighbours within the blur are not independent
            error = np.sqrt(np.trace(np.linalg.inv(normal)[1:, 1:])) * spread * np.sqrt(2 * np.pi) * width
            shift = float(np.hypot(*found[1:]))
            moved = columns[:, 1:] @ found[1:]
            least = moved <= np.percentile(moved, LEAST_PERCENT)
            falls = float(np.mean((along - crossed)[whole][least] < 0))  # a highlight alone makes nothing darker
            if shift > SHIFT_SIGMAS * error and falls > FALLING_PART:
                largest = max(largest, shift)
    return largest


def _blurred(image: np.ndarray, width: float) -> np.ndarray:
    """Return an image [rows, cols] blurred by a Gaussian of this standard deviation, normalised at the border."""
    rows, cols = (np.exp(-((np.arange(size)[:, None] - np.arange(size)) ** 2) / (2 * width**2)) for size in image.shape)
    return np.asarray(rows / rows.sum(axis=1, keepdims=True) @ image @ (cols / cols.sum(axis=1, keepdims=True)).T)


def _block(mask: np.ndarray) -> np.ndarray:
    """Return the positions [rows, cols] of the part of the image that holds the most of the object."""
    side = tuple(min(BLOCK, size) for size in mask.shape)
    centre = np.argwhere(mask).mean(axis=0)
    corner = [int(np.clip(round(middle - size / 2), 0, whole - size)) for middle, size, whole in zip(centre, side, mask.shape, strict=True)]
    rows, cols = (start + np.arange(size) for start, size in zip(corner, side, strict=True))
    return np.asarray(rows[:, None] * mask.shape[1] + cols)


def _grey(cross: Stack, parallel: Stack, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return [lights, n] the mean of the channels of both images, and which readings are usable."""
    crossed, usable = cross.pick_radiance(pixels)
    along, also = parallel.pick_radiance(pixels)
    return crossed.mean(axis=-1), along.mean(axis=-1), usable & also
