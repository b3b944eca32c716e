"""Test whether two estimates of a pixel, taken one after the other, are of one surface at rest, and how much of their error is noise.

Nothing is known of the motion of a subject, so that nothing is carried along it. Two estimates agree where their difference is no more
than noise explains: at the pixel, and in the mean over the pixels around it, which shows a motion of a fraction of the noise. A mean of
estimates that pass is not further from the truth than the last one alone: what motion may add is less than what the mean takes away.

How much of a standard deviation is noise is measured. Errors that are the same in every step, as those of lights or of a model, are in σ
too, but do not differ between steps. The difference of two steps less that of its neighbours is noise, whatever moves, as far as the
motion is alike at neighbouring pixels.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

MEDIANS = {1: 0.4549, 2: 0.6931, 3: 0.7887}
"""Median of χ² over its degrees of freedom, by these."""
LIMITS = {1: 12.12, 2: 7.60, 3: 5.91}
"""Quantile of 99.95 % of χ² over its degrees of freedom, by these."""
RADII = (1, 3, 7)
"""Radii in pixels of the squares over which differences are averaged."""
LEAST_AROUND = 0.5
"""Least part of the pixels in the second square that agree by themselves."""
MEMORY, RECENT = 16, 4
"""A step has at least these parts, one over each, of the mean and of that of the last steps."""
CHANCE = 4.0
"""The square of a lag counts beyond this many times its variance by noise, which of nine squares around a pixel the largest may have."""
LEAST_PIXELS = 64
"""Least number of pixels from which a share of noise is measured."""
BINS = 4
"""Parts of the pixels, by size of σ, for each of which the share of noise is measured."""
LEAST_SHARE, MOST_SHARE = 1e-4, 2.0
"""Bounds of the share: above the second, motion and not noise differs between neighbours."""

Estimate = tuple[np.ndarray, np.ndarray]
"""Values [rows, cols, k] and their variance by noise [rows, cols]."""


def noise_share(
    difference: np.ndarray,  # [rows, cols, k] of two steps
    variance: np.ndarray,  # [rows, cols] of the difference as the steps declare it: the mean of its squared length
    both: np.ndarray,  # [rows, cols] bool, where both steps have an estimate
    freedom: int,  # in how many directions the difference can point
) -> np.ndarray:
    """Return which part of a variance is noise that differs from step to step.
    Returns [rows, cols] float32, LEAST_SHARE to MOST_SHARE; 1 where too few pixels tell."""
    share = np.ones(both.shape, np.float32)
    inner = np.zeros_like(both)
    inner[1:-1, 1:-1] = both[1:-1, 1:-1] & both[:-2, 1:-1] & both[2:, 1:-1] & both[1:-1, :-2] & both[1:-1, 2:]
    if np.count_nonzero(inner) < LEAST_PIXELS:
        return share
    apart, spread = np.zeros_like(difference), np.ones_like(variance)
    apart[1:-1, 1:-1] = difference[1:-1, 1:-1] - _beside(difference) / 4
    spread[1:-1, 1:-1] = variance[1:-1, 1:-1] + _beside(variance) / 16
    ratio = ((apart**2).sum(axis=-1) / np.maximum(spread, 1e-30))[inner]
    size = variance[inner]
    edges = np.quantile(size, np.linspace(0, 1, BINS + 1)[1:-1]) if len(ratio) >= BINS * LEAST_PIXELS else np.zeros(0)
    number, everywhere = np.searchsorted(edges, size), np.searchsorted(edges, variance)
    for part in range(len(edges) + 1):
        inside = ratio[number == part]
        told = inside if len(inside) >= LEAST_PIXELS else ratio
        share[everywhere == part] = np.clip(np.median(told) / MEDIANS[freedom], LEAST_SHARE, MOST_SHARE)
    return share


def agree(difference: np.ndarray, variance: np.ndarray, both: np.ndarray, freedom: int) -> np.ndarray:
    """Return where a difference is no more than noise, at the pixel and in the mean around it, [rows, cols] bool; arguments are those of
    noise_share, with the variance of noise alone."""
    limit = LIMITS[freedom]
    found = both & ((difference**2).sum(axis=-1) <= limit * variance)
    found &= _window(found, RADII[1]) >= LEAST_AROUND * _window(both, RADII[1])  # among pixels that disagree, one agrees by chance
    for radius in RADII:  # over the pixels that pass so far, so that what moves fast does not keep the part at rest around it apart
        total = np.stack([_window(np.where(found, difference[..., k], 0), radius) for k in range(difference.shape[-1])], axis=-1)
        found = found & ((total**2).sum(axis=-1) <= limit * _window(np.where(found, variance, 0), radius))
    return found


def _beside(values: np.ndarray) -> np.ndarray:
    """Return the sum of the four neighbours of every inner pixel."""
    return np.asarray(values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:])


def _window(values: np.ndarray, radius: int) -> np.ndarray:
    """Return the sum over a square around each pixel, [rows, cols] float64."""
    total = values.astype(np.float64)
    for axis in (0, 1):
        padded = np.pad(total, [(radius + 1, radius) if a == axis else (0, 0) for a in (0, 1)])
        running = padded.cumsum(axis=axis)
        width = 2 * radius + 1
        total = np.take(running, range(width, running.shape[axis]), axis) - np.take(running, range(running.shape[axis] - width), axis)
    return total


@dataclass(frozen=True)
class Track:
    """The mean of the estimates of each pixel since it last began anew."""

    mean: np.ndarray  # [rows, cols, k] float32
    noise: np.ndarray  # [rows, cols] float32, variance of the mean by noise
    constant: np.ndarray  # [rows, cols] float32, standard deviation that all steps share
    count: np.ndarray  # [rows, cols] int32, steps that are joined; 0 where there is no estimate
    recent: np.ndarray  # [rows, cols, k] float32, the mean in which a step has half of its weight after three
    recent_noise: np.ndarray  # [rows, cols] float32, its variance by noise
    lag: np.ndarray  # [rows, cols] float32, square of what the mean lags behind the last step, or the mean of the last ones, beyond noise

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of the mean, [rows, cols] float32."""
        return np.sqrt(self.noise + self.constant**2 + self.lag)


def begin(
    values: np.ndarray,  # [rows, cols, k]
    sigma: np.ndarray,  # [rows, cols], standard deviation: root of the mean squared length of the error
    share: np.ndarray,  # [rows, cols] part of its square that is noise, which may be above 1
    valid: np.ndarray,
) -> Track:
    """Return the track of the estimates of one step."""
    noise = np.where(valid, share * sigma**2, 0).astype(np.float32)
    constant = np.where(valid, np.sqrt(np.maximum(1 - share, 0)) * sigma, 0).astype(np.float32)
    mean = np.where(valid[..., None], values, 0).astype(np.float32)
    return Track(mean, noise, constant, valid.astype(np.int32), mean, noise, np.zeros_like(noise))


def advance(track: Track, new: Track, joined: np.ndarray, *, unit: bool = False) -> Track:
    """Return the track after a further step.
    `new`: of the step alone, of `begin`. `joined`: [rows, cols] bool, where both agree; elsewhere the step stands alone. `unit`: whether
    means are directions."""
    gain, (mean, noise), (recent, recent_noise) = _means(track, new, joined, unit)
    constant = np.where(joined, track.constant + gain * (new.constant - track.constant), new.constant).astype(np.float32)
    lag = np.maximum((1 - gain) ** 2 * _beyond(new.mean - track.mean, new.noise + track.noise, joined),
                     _beyond(recent - mean, np.maximum(recent_noise - noise, 0), joined)).astype(np.float32)
    return Track(mean, noise, constant, np.where(joined, track.count + 1, new.count).astype(np.int32), recent, recent_noise, lag)


def _means(track: Track, new: Track, joined: np.ndarray, unit: bool) -> tuple[np.ndarray, Estimate, Estimate]:
    """Return the weight of a further step in the mean, [rows, cols], and after it the mean of all steps and that of the last ones."""
    gain = np.where(joined, np.maximum(track.noise / np.maximum(track.noise + new.noise, 1e-30), 1 / MEMORY), 1).astype(np.float32)
    equal = joined & (track.noise + new.noise == 0)
    gain = np.where(equal, 1 / (track.count + 1), gain).astype(np.float32)
    quick = np.maximum(gain, np.float32(1 / RECENT))
    mean, recent = (before + weight[..., None] * (new.mean - before) for before, weight in ((track.mean, gain), (track.recent, quick)))
    if unit:
        mean, recent = (values / np.maximum(np.linalg.norm(values, axis=-1, keepdims=True), 1e-20) for values in (mean, recent))
    mean, recent = (np.where(joined[..., None], values, new.mean).astype(np.float32) for values in (mean, recent))
    noise, recent_noise = (np.where(joined, (1 - weight) ** 2 * before + weight**2 * new.noise, new.noise).astype(np.float32)
                           for before, weight in ((track.noise, gain), (track.recent_noise, quick)))
    return gain, (mean, noise), (recent, recent_noise)


def _beyond(difference: np.ndarray, variance: np.ndarray, joined: np.ndarray) -> np.ndarray:
    """Return the largest square of the mean of a difference, [rows, cols, k], over 3 × 3 pixels that hold a pixel, beyond what noise makes,
    [rows, cols]; 0 where nothing is joined."""
    pixels = np.maximum(_window(joined, 1), 1)
    square = sum((_window(np.where(joined, difference[..., k], 0), 1) / pixels) ** 2 for k in range(difference.shape[-1]))
    noise = _window(np.where(joined, variance, 0), 1) / pixels**2
    return np.where(joined, maximum_filter(np.maximum(square - CHANCE * noise, 0), 3), 0)


def steady(track: Track, new: Track, joined: np.ndarray, freedom: int, *, unit: bool = False) -> np.ndarray:
    """Return where the mean after a further step does not lag behind the last steps, as it does behind what moves slowly, [rows, cols]
    bool; arguments are those of `advance`, with the freedom of `noise_share`."""
    _, (mean, noise), (recent, recent_noise) = _means(track, new, joined, unit)
    return agree(recent - mean, np.maximum(recent_noise - noise, 0), joined, freedom)
