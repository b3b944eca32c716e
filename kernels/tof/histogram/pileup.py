"""Pile-up: a detector that counts only the first photon after each pulse favours early bins. Coates's correction undoes it."""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import take_columns

LEFT_OVER = 0.5
"""Number of pulses that count as left after a bin that took them all: the logarithm of zero is not finite, and dropping the bin would move
the return."""
EXHAUSTED = 1e-3
"""Least part of the pulses that must be left for a bin to be used: with fewer, the correction divides by a number that is mostly chance."""


class LiveCounts(NamedTuple):
    """Photon counts and the fraction of all pulses for which the detector was still live, that is, had not yet counted a photon; [bin,
    pixel] on the device."""

    counts: wp.array  # float32: expected photons of the pulses that were left
    live: wp.array  # float32, 0…1: fraction of the pulses without an earlier photon
    pulses: float = np.inf  # of each histogram; finite where a pulse counts one photon at most: counts are binomial then, else Poisson

    def of(self, pixels: np.ndarray) -> "LiveCounts":
        """Return the histograms of some pixels [n], copied on the device; not synchronised on CUDA."""
        device = str(self.counts.device)
        columns = wp.array(pixels, dtype=wp.int32, device=device)
        taken = [wp.empty((array.shape[0], len(pixels)), dtype=wp.float32, device=device) for array in (self.counts, self.live)]
        for array, some in zip((self.counts, self.live), taken, strict=True):
            take_columns(array, columns, 0, some)
        return LiveCounts(*taken, self.pulses)


def checked(counts: np.ndarray) -> np.ndarray:
    """Return histograms [pixel, bin] as contiguous float32.
    Raises ArrayError: wrong shape, negative or not finite counts, or not one count in all of them."""
    if counts.ndim != 2 or counts.shape[1] < 3:
        raise ArrayError(f"histograms are {counts.shape}: give [pixel, bin] with three bins or more")
    values = np.ascontiguousarray(counts, dtype=np.float32)
    if not np.isfinite(values).all() or values.min(initial=0.0) < 0:
        raise ArrayError("histograms hold counts that are negative or not finite: give photons")
    if not values.any():
        raise ArrayError("every histogram is empty: no photon was counted")
    return values


def place(counts: np.ndarray, device: str) -> wp.array:
    """Return histograms [pixel, bin] on the device as [bin, pixel] float32, laid out so that the threads of the device read them in order.
    Raises ArrayError: as `checked`."""
    values = checked(counts)
    if device == "cpu":  # a thread is one pixel after another: its bins stay together
        return wp.array(values, dtype=wp.float32, device=device).transpose()
    return wp.array(values.T, dtype=wp.float32, device=device)


def correct_pileup(counts: wp.array, *, pulses: int) -> LiveCounts:
    """Undo pile-up: return the photons that a detector without dead time would have counted in each bin.

    Of `pulses`, those without a photon in bins before i are left at bin i; of these the counted part q had at least one photon in the
    bin, so that the expected number is -ln(1 - q) a pulse.

    Args:
        counts: [bin, pixel] float32 first photons, on the device.
        pulses: laser pulses of each histogram.

    Returns:
        The photons that the pulses left at each bin would have counted, whose mean is live · flux, the fraction of the pulses left, and
        `pulses`. A bin with less than EXHAUSTED of the pulses left has live 0.

    Source:
        Coates, "The correction for photon `pile-up' in the measurement of radiative lifetimes", J. Phys. E 1(8), 1968.
    """
    if pulses < 1:
        raise ArrayError(f"pulses is {pulses}: pile-up is corrected with the number of laser pulses, one or more")
    corrected, live = wp.zeros_like(counts), wp.zeros_like(counts)
    devices.launch(_coates_kernel, counts.shape[1], [counts, float(pulses)], [corrected, live], device=str(counts.device))
    return LiveCounts(corrected, live, float(pulses))


def without_pileup(counts: wp.array) -> LiveCounts:
    """Return the counts of a detector without dead time, which is always live, in the form of correct_pileup."""
    return LiveCounts(counts, wp.full(counts.shape, 1.0, dtype=wp.float32, device=counts.device))


@wp.kernel(module="unique")
def _coates_kernel(first: int,
                   counts: wp.array2d(dtype=wp.float32),  # [bin, pixel]
                   pulses: float,
                   # outputs
                   corrected: wp.array2d(dtype=wp.float32),
                   live: wp.array2d(dtype=wp.float32)):
    p = first + wp.tid()
    left = float(pulses)
    for i in range(counts.shape[0]):
        n = counts[i, p]
        if left > EXHAUSTED * pulses:
            q = wp.min(n, wp.max(left - LEFT_OVER, 0.5 * left)) / left
            rate = -wp.log(1.0 - q)
            if q < 1.0e-3:  # the logarithm of nearly one loses its digits
                rate = q + 0.5 * q * q
            corrected[i, p] = left * rate
            live[i, p] = left / pulses
        left = wp.max(left - n, 0.0)
