"""The misfit of returns: how much larger the residuals in their bins are than photon noise."""

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.tof.histogram.likelihood import (
    Recorded,
    Shape,
    counted,
    counted_part,
    end_bin_of,
    first_bin_of,
    mean_of_bin,
    recorded,
    returns_found,
    shape,
)
from kernels.tof.histogram.pileup import LiveCounts
from kernels.tof.histogram.pulse import Pulse
from kernels.tof.histogram.returns import Returns

LEAST_MEAN = 1.0
"""Expected count from which a bin is tested: residuals are nearly normal from there."""
FITTED = 2.0
"""Numbers fitted to the bins of a return: time and strength."""
CHANCE_SIGMAS = 3.5
"""Standard deviations of the sum of squared residuals up to which it is left to chance: about one pixel in a thousand, since the
distribution is skewed."""


def misfit(histograms: LiveCounts, pulse: Pulse, found: Returns) -> np.ndarray:
    """Return the dispersion of each return's residuals, [return, pixel] float32; 1 where chance explains them.

    A pulse of another shape, counts that are not photons' and light that no return describes make residuals larger than Poisson noise. The
    variance of the time grows in proportion, as if the photons were fewer (quasi-likelihood).

    Source:
        Wedderburn, "Quasi-likelihood functions, generalized linear models, and the Gauss-Newton method", Biometrika 61(3), 1974.
    """
    device = str(histograms.counts.device)
    result = wp.zeros(found.photons.shape, dtype=wp.float32, device=device)
    devices.launch(_misfit_kernel, histograms.counts.shape[1], [recorded(histograms), shape(pulse, device), found.position, found.photons,
                                                                found.background], [result], device=device, uneven=True)
    return np.asarray(to_numpy(result))


@wp.kernel(module="unique", module_options={"max_unroll": 0})  # unrolled, it is no faster and takes seconds to compile
def _misfit_kernel(first: int,
                   given: Recorded,
                   pulse: Shape,
                   position: wp.array2d(dtype=wp.float32),  # [return, pixel]
                   photons: wp.array2d(dtype=wp.float32),  # [return, pixel]
                   background: wp.array(dtype=wp.float32),
                   # outputs
                   dispersion: wp.array2d(dtype=wp.float32)):
    p = first + wp.tid()
    b = background[p]
    found = returns_found(photons, p)
    for k in range(position.shape[0]):
        value = float(1.0)
        if k < found:
            squares = float(0.0)
            spread = float(0.0)
            used = float(0.0)
            t = position[k, p]
            for i in range(first_bin_of(pulse, t), end_bin_of(pulse, t, given.counts.shape[0])):
                rate = mean_of_bin(pulse, i, p, -1, found, b, position, photons)
                x = rate * given.per_pulse
                mean = given.live[i, p] * rate * counted_part(x)
                if mean > LEAST_MEAN:
                    off = counted(given, i, p) - mean
                    squares += off * off / (mean * wp.exp(-x))  # first photons are binomial
                    spread += 2.0 + 1.0 / mean
                    used += 1.0
            freedom = used - FITTED
            if freedom > 0.0 and squares > freedom + CHANCE_SIGMAS * wp.sqrt(spread):
                value = squares / freedom
        dispersion[k, p] = value
