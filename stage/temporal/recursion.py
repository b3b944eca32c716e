"""The recursive mean of estimates that agree, weighted by their noise: a Kalman filter of a state at rest, which begins anew where it did
not rest.

Source: Kalman, "A new approach to linear filtering and prediction problems", Journal of Basic Engineering 82(1), 1960, for a constant
    state; the error that is the same in every step is carried beside it and never averaged away.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Track:
    """The mean of the estimates of each pixel since it last began anew."""

    mean: np.ndarray  # [rows, cols, k] float32
    noise: np.ndarray  # [rows, cols] float32, variance of the mean by noise
    constant: np.ndarray  # [rows, cols] float32, standard deviation that all steps share
    count: np.ndarray  # [rows, cols] int32, steps that are joined; 0 where there is no estimate

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of the mean, [rows, cols] float32."""
        return np.sqrt(self.noise + self.constant**2)


def begin(values: np.ndarray, sigma: np.ndarray, share: np.ndarray, valid: np.ndarray) -> Track:
    """Return the track of the estimates of one step.

    Args:
        values: [rows, cols, k].
        sigma: [rows, cols], standard deviation: root of the mean squared length of the error.
        share: [rows, cols] part of its square that is noise, which may be above 1.
        valid: [rows, cols] bool, where there is an estimate.
    """
    noise = np.where(valid, share * sigma**2, 0).astype(np.float32)
    constant = np.where(valid, np.sqrt(np.maximum(1 - share, 0)) * sigma, 0).astype(np.float32)
    return Track(np.where(valid[..., None], values, 0).astype(np.float32), noise, constant, valid.astype(np.int32))


def advance(track: Track, new: Track, joined: np.ndarray, *, unit: bool = False) -> Track:
    """Return the track after a further step.

    Args:
        track: so far.
        new: of the step alone, of `begin`.
        joined: [rows, cols] bool, where both agree; elsewhere the step stands alone.
        unit: whether means are directions.
    """
    gain = np.where(joined, track.noise / np.maximum(track.noise + new.noise, 1e-30), 1).astype(np.float32)
    equal = joined & (track.noise + new.noise == 0)
    gain = np.where(equal, 1 / (track.count + 1), gain).astype(np.float32)
    mean = track.mean + gain[..., None] * (new.mean - track.mean)
    if unit:
        length = np.linalg.norm(mean, axis=-1, keepdims=True)
        mean = np.where(length > 0, mean / np.maximum(length, 1e-20), 0)
    mean = np.where(joined[..., None], mean, new.mean)
    noise = np.where(joined, gain * new.noise, new.noise)
    constant = np.where(joined, track.constant + gain * (new.constant - track.constant), new.constant)
    return Track(mean.astype(np.float32), noise.astype(np.float32), constant.astype(np.float32),
                 np.where(joined, track.count + 1, new.count).astype(np.int32))
