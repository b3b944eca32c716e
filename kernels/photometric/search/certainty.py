"""Estimate the certainty of a normal of the hypothesis search: its standard deviation, and the probability that it is at the right mode.

The costs are taken as twice the negative logarithm of a likelihood, of a noise that the misfit itself measures. Near the best normal
the descent gives the curvature in every direction; further off the costs of the survey are weights of candidates that the readings
may mean as well. A reading teaches something only beyond the unknowns that it must pay for, so that few lights, which any lobes can follow,
leave a normal open; and misfit beyond the noise of a camera is the same under neighbouring lights, so that many lights hardly average it.

Sources: variance from curvature and residual as in non-linear least squares (Seber and Wild, "Nonlinear Regression", 1989, section 2.1);
mass of a mode against that of all others after MacKay, "Information Theory, Inference, and Learning Algorithms", 2003, chapter 27; that a
robust fit breaks down where half of the readings contradict it is Rousseeuw and Leroy, "Robust Regression and Outlier Detection", 1987,
section 1.2; that s readings which could have contradicted a model and did not make it right with (s + 1)/(s + 2) is Laplace's rule of
succession. The share of misfit that lights do not average is ours, measured on the objects of benchmarks/trust.py.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import pack_type, vector_at
from kernels.photometric.model.candidates import candidate_at, rings
from kernels.photometric.model.samples import Samples, per_pixel, to_host
from kernels.photometric.search.normal_search import Found
from kernels.photometric.search.survey import Survey, evidence, noise_of

LEAST_RISE = 0.05
"""Least rise of the cost in the flattest direction as a fraction of the mean: less is rounding."""
UNAVERAGED = 0.45
"""Part of the variance of a reading's misfit that remains however many lights there are, for each share of it that neighbouring pixels have
in common: what pixels share, neighbouring lights share too. Measured, as the numbers below, on path-traced scenes and real objects."""
FREE = 0.4
"""Part of the variance by the curvature of the mixture, and of the squared spread of models averaged, that errors have: lobes that are free
let a normal go further than the truth does, and a mean errs less than what it is the mean of."""
SOFTNESS = 0.2
"""Part of the whole cost by which costs of candidates may differ through misfit of the model alone."""
BREAKDOWN = 0.5
"""Cost of a reading at which half of the readings contradict the normal, a contradiction costing about 1: no robust fit survives that."""
FLATTEST, MOST_ELSEWHERE, MOST = 16.0, 25.0, 29.0
"""Most that the flatness of a mode and that other modes count in the standard deviation, and the most that it says, degrees: normals of
which hardly anything is known count as solved unless less than that is asked for."""
APART_DEGREES, APART_SIGMAS = 4.0, 3.0
"""A candidate belongs to another mode when it is further away than this, in degrees and in standard deviations."""

UNDESCRIBED = 0.9
"""Logarithm of the factor on the standard deviation where half of the readings contradict the normal."""


class SingleLobe(NamedTuple):
    """The joint fit of a single lobe, where it takes part in the average of a pixel's normals; [n] each."""

    weight: np.ndarray  # 0…1, of its normal
    cost: np.ndarray  # per light
    openness: np.ndarray  # variance of its normal per unit of noise, squared radians


def standard_deviation(samples: Samples, found: Found, normal: np.ndarray, spread: np.ndarray, doubt: np.ndarray,
                       single: SingleLobe | None, shared: float) -> np.ndarray:
    """Return the standard deviation of the normals of a search in degrees, [n] float32; waits for the device.
    `normal`: [n, 3] unit, the result, which may be an average of several searches. `spread`: [n] of that average, degrees. `doubt`: [n]
    degrees, by the shape of the lobes. `single`: the single lobe, whose curvature and noise count by its weight; None: it takes no part.
    `shared`: 0…1, of `shared_misfit`."""
    lights = samples.light_count
    total, surplus, noise = evidence(samples, found.best.cost, found.best.weights)
    mean = lights * np.maximum(found.best.curvature.astype(np.float64), 1e-12)
    swing = np.minimum(lights * found.best.swing, (1 - LEAST_RISE) * mean)
    alike = 1 + UNAVERAGED * lights * shared
    mixed, around = np.ones(len(normal)), FREE * _around(2 * mean / (mean**2 - swing**2), noise, alike)
    if single is not None:
        mixed = 1 - single.weight.astype(np.float64)
        alone = noise_of(lights * single.cost.astype(np.float64), surplus)
        around = mixed * around + single.weight * _around(single.openness.astype(np.float64), alone, alike)
        noise = mixed * noise + single.weight * alone
    variance = np.minimum(around + mixed * doubt.astype(np.float64) ** 2 + FREE * spread.astype(np.float64) ** 2, FLATTEST**2)
    apart = np.maximum(APART_DEGREES, APART_SIGMAS * np.sqrt(variance))
    softness = 2 * noise + SOFTNESS * total
    judged = np.stack([total, softness, np.cos(np.radians(np.minimum(apart, 180)))], axis=1)
    here, there, moment = _masses(found.survey, normal, judged).astype(np.float64).T
    here = np.maximum(here, math.pi * variance)
    elsewhere = mixed * there / (here + there) * np.sqrt(moment / np.maximum(there, 1e-20))
    unchecked = (surplus + 2) / (surplus + 1)
    undescribed = np.exp(UNDESCRIBED * np.minimum(noise / BREAKDOWN, 1) ** 2)
    sigma = unchecked * undescribed * np.hypot(np.sqrt(variance), np.minimum(elsewhere, MOST_ELSEWHERE))
    return np.asarray(np.minimum(sigma, MOST), dtype=np.float32)


def _around(openness: np.ndarray, noise: np.ndarray, alike: float) -> np.ndarray:
    """Return the variance about a mode, [n] squared degrees, of a normal whose variance per unit of noise is given in squared radians.
    `alike`: how much more of it misfit that lights share causes than independent noise."""
    return np.asarray(np.minimum(np.degrees(1.0) ** 2 * openness * noise, FLATTEST**2) * alike)


def _masses(surveyed: Survey | None, normal: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Return [n, 3]: weight of the candidates at the normal, of all others, and the others' second moment about it; degrees², degrees⁴.

    Pixels that were not surveyed have none.
    """
    whole = np.zeros((len(normal), 3), np.float32)
    if surveyed is None:
        return whole
    pixels, samples, middle, costs, ringed = surveyed
    masses = wp.empty((3, samples.packs), dtype=pack_type(samples.lanes, wp.float32), device=samples.device)
    offsets = rings(*ringed)
    weighed = np.column_stack([offsets, ring_areas(offsets)])
    devices.launch(_mass_kernel(samples.lanes), samples.packs,
                   [costs, wp.array(weighed, dtype=wp.types.vector(5, wp.float32), device=samples.device), per_pixel(samples, middle),
                    samples.view, per_pixel(samples, normal[pixels]), per_pixel(samples, judged[pixels])],
                   [masses], device=samples.device)
    whole[pixels] = to_host(samples, masses)
    return whole


def ring_areas(offsets: np.ndarray) -> np.ndarray:
    """Return the solid angle that each candidate of `candidates.rings` stands for, [candidates] in degrees².

    A ring reaches half-way to its neighbours, the last one as far beyond as it does inside.
    """
    angle, ring, count = np.unique(np.degrees(np.arctan2(offsets[:, 0], offsets[:, 1])).round(3), return_inverse=True, return_counts=True)
    middle = (angle[1:] + angle[:-1]) / 2
    edge = np.concatenate([[0], middle, [2 * angle[-1] - middle[-1]]])
    cap = 2 * np.pi * (1 - np.cos(np.radians(edge))) * np.degrees(1.0) ** 2
    return (np.diff(cap) / count)[ring]


@once
def _mass_kernel(lanes: int) -> Any:
    lane_type, offset_type = pack_type(lanes, wp.float32), wp.types.vector(5, wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def mass_kernel(first: int,
                    costs: wp.array2d(dtype=lane_type),  # [candidates, P]
                    offsets: wp.array(dtype=offset_type),  # [candidates] of `rings`, and the solid angle
                    start: wp.array2d(dtype=lane_type),  # [3, P]
                    view: wp.array2d(dtype=lane_type),  # [3, P]
                    normal: wp.array2d(dtype=lane_type),  # [3, P]
                    judged: wp.array2d(dtype=lane_type),  # [3, P] least cost, softness, cosine beyond which a candidate is another mode's
                    # outputs
                    masses: wp.array2d(dtype=lane_type)):  # [3, P]
        p = first + wp.tid()
        sx, sy, sz = vector_at(start, p)
        vx, vy, vz = vector_at(view, p)
        nx, ny, nz = vector_at(normal, p)
        least, soft, far = vector_at(judged, p)
        for candidate in range(costs.shape[0]):
            cost = costs[candidate, p]
            for k in range(lanes):
                least[k] = wp.min(least[k], cost[k])
        here, there, moment = lane_type(), lane_type(), lane_type()
        for candidate in range(costs.shape[0]):
            cost = costs[candidate, p]
            o = offsets[candidate]
            for k in range(lanes):
                n = candidate_at(wp.vec3(sx[k], sy[k], sz[k]), wp.vec4(o[0], o[1], o[2], o[3]), wp.vec3(vx[k], vy[k], vz[k]))
                cosine = wp.clamp(n[0] * nx[k] + n[1] * ny[k] + n[2] * nz[k], -1.0, 1.0)
                weight = o[4] * wp.exp((least[k] - cost[k]) / wp.max(soft[k], 1.0e-12))
                angle = wp.degrees(wp.acos(cosine))
                other = wp.where(cosine < far[k], weight, 0.0)
                here[k] += weight - other
                there[k] += other
                moment[k] += other * angle * angle
        masses[0, p] = here
        masses[1, p] = there
        masses[2, p] = moment

    return mass_kernel
