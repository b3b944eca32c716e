"""Other modes of the cost: candidates on wide rings, for pixels whose readings may mean another normal than the one found.

A pixel whose readings are explained to little more than the noise of a camera, with readings to spare, has one mode (docs/svbrdf.md says
how many exceptions were found). The others are surveyed: candidates on rings about the normal found are judged as in `hypotheses`. The best
of them is the start of another descent, and the costs of all say how probable other modes are (`certainty`). What the readings of a pixel
say beyond the unknowns that they had to pay for is their evidence.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import pack_type
from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.model.samples import Samples, samples_type, to_host
from kernels.photometric.search.descent import Descent, Schedule, descend
from kernels.photometric.search.hypotheses import LobeShape, Prior, RingOptions, SearchOptions, search_normals
from kernels.photometric.search.search_kernel import SURVEY_REWEIGHTINGS

INFORMATIVE = 0.1
"""Part of a pixel's level below which a reading is shadow and says little: it does not count as information."""
USED = 1e-3
"""Weight above which a lobe of the mixture counts as an unknown that the readings have paid for."""
DIRECTION = 2
"""Unknowns of a unit normal."""
EXPECTED_COST, PSEUDO_READINGS = 0.05, 1.0
"""Cost of a reading that is expected before any is seen, and the number of readings that this expectation counts as: real and path-traced
objects have 0.01 to 0.15 under many lights, and a fit with as many unknowns as readings has no misfit of its own."""


class Evidence(NamedTuple):
    """The quality of the explanation of each sampled pixel's readings."""

    total: np.ndarray  # [n] float64, cost of all readings
    surplus: np.ndarray  # [n] readings that could have contradicted the fit
    noise: np.ndarray  # [n] float64, cost of a reading beyond the unknowns


def evidence(samples: Samples, cost: np.ndarray, weights: np.ndarray) -> Evidence:
    """Return what fits of sampled pixels, of cost [n] per light and mixture [n, lobes], leave unexplained; waits for the device."""
    unknowns = DIRECTION + (weights > USED).sum(axis=1)
    total = cost.astype(np.float64) * samples.light_count
    informative = wp.empty(samples.packs, dtype=pack_type(samples.lanes, wp.float32), device=samples.device)
    devices.launch(_count_kernel(samples.lanes), samples.packs, [samples.arrays], [informative], device=samples.device)
    surplus = np.maximum(to_host(samples, informative) - unknowns, 0)
    return Evidence(total, surplus, noise_of(total, surplus))


def noise_of(total: np.ndarray, surplus: np.ndarray) -> np.ndarray:
    """Return the cost of a reading beyond the unknowns, [n], where all cost [n] and so many could have contradicted the fit, [n]."""
    return np.asarray((total + EXPECTED_COST * PSEUDO_READINGS) / (surplus + PSEUDO_READINGS))


@once
def _count_kernel(lanes: int) -> Any:
    lane_type, samples_struct = pack_type(lanes, wp.float32), samples_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def count_kernel(first: int,
                     samples: samples_struct,
                     # outputs
                     counts: wp.array(dtype=lane_type)):  # [P]
        p = first + wp.tid()
        count = lane_type()
        for light in range(samples.light_count):
            y = samples.grey[p * samples.pack_stride + light * samples.light_stride]
            for k in range(lanes):
                count[k] += wp.where(y[k] > INFORMATIVE, 1.0, 0.0)
        counts[p] = count

    return count_kernel


AGAIN = Schedule(softened=2, judged=6, softness=4.0, cooling=0.25)
"""Descent from the best candidate."""
SPARE = 24
"""Readings beyond the unknowns from which on being explained means something."""


class Sweep(NamedTuple):
    """The candidates of a survey, and the cost above which a pixel is surveyed."""

    rings: tuple[tuple[float, ...], int]
    """Radii of the rings, degrees, and the number of candidates on the last of them."""
    explained: float
    """Cost of a reading beyond the unknowns up to which a pixel counts as explained."""


CLOSE = Sweep(((5.0, 10.0, 16.0, 24.0, 34.0, 46.0), 20), 0.03)
"""The survey that tells how probable other modes are."""
QUICK = Sweep(((5.0, 10.0, 16.0, 24.0, 34.0, 46.0), 14), 0.04)
"""The survey that looks for a better mode: it finds nearly all that a close survey does, in two thirds of the time."""


class Survey(NamedTuple):
    """The costs of candidates, for some of the sampled pixels."""

    pixels: np.ndarray  # [m] positions among the sampled pixels
    samples: Samples  # of these pixels
    middle: np.ndarray  # [m, 3] float32 unit normals that the rings are about
    costs: wp.array  # [candidates, packs] float packs, on the device: cost of each candidate, summed over the lights
    rings: tuple[tuple[float, ...], int]
    """The rings on which the candidates lie, as in `Sweep`."""


def survey(samples: Samples, found: Descent, *, shape: LobeShape, options: SearchOptions | None = None,
           prior: Prior | None = None, sweep: Sweep = CLOSE) -> Survey | None:
    """Survey the pixels that may have another mode, and take over better ones into their descents, in place; waits for the device.

    Returns None if no pixel needs a survey. `sweep` says which pixels are surveyed, and how closely.
    """
    told = evidence(samples, found.cost, found.weights)
    pixels = np.flatnonzero((told.noise > sweep.explained) | (told.surplus < SPARE))
    if not len(pixels):
        return None
    chosen, middle = choose(samples, pixels), found.normal[pixels]
    drawn = None if prior is None else prior._replace(normal=prior.normal[pixels])
    rounds = RingOptions.of(options or SearchOptions(), reweightings=SURVEY_REWEIGHTINGS)
    ringed = search_normals(chosen, middle, shape=shape, options=rounds, wide=sweep.rings, prior=drawn)
    found.replace(pixels, descend(chosen, ringed.normal, shape=shape, options=options, weights=ringed.weights, prior=drawn,
                                  schedule=AGAIN))
    return Survey(pixels, chosen, middle, ringed.survey, sweep.rings)
