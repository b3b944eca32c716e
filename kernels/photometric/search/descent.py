"""Normals by descent: the normal of least cost near a start, by Gauss-Newton steps under the cost of the hypothesis search.

The readings are explained by a non-negative mixture of a diffuse and five GGX lobes, with Cauchy weights and shadows as in `hypotheses`.
Two tilts of the normal and the weights of the mixture are the unknowns of one re-weighted least-squares problem. In each turn the weights
above zero are eliminated (variable projection), the tilts are solved for, and the weights follow, non-negative, for the moved normal. A
turn that costs more is undone, and the next step is shorter. The first turns take the noise for larger than it is, so that a highlight
that lies elsewhere than predicted pulls the normal before it counts as an outlier. The curvature of the reduced problem says how sure the
normal is.

Sources: separable least squares after Golub and Pereyra, "Separable nonlinear least squares: the variable projection method and its
applications", Inverse Problems 2003; damping after Levenberg and Marquardt (Nocedal and Wright, "Numerical Optimization", 2006, section
10.3); noise that falls to its value after Blake and Zisserman, "Visual Reconstruction", 1987 (graduated non-convexity).
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.photometric.model.lobes import MIXTURE
from kernels.photometric.model.samples import Samples, per_pixel, to_host
from kernels.photometric.search.descent_kernel import descent_kernel
from kernels.photometric.search.hypotheses import LobeShape, Prior, SearchOptions, criteria, prior_pull


class Schedule(NamedTuple):
    """The turns of a descent."""

    softened: int
    """First turns, in which the noise counts as larger and no turn is undone."""
    judged: int
    """Turns that follow, in which the cost decides."""
    softness: float = 1.0
    """Factor on the variance of the noise in the first turn."""
    cooling: float = 1.0
    """Factor on this factor from turn to turn; it does not fall below 1."""


COLD = Schedule(softened=6, judged=9, softness=256.0, cooling=0.3)
"""Schedule from a normal that is off by up to some 20 degrees, with no weights. Fewer turns leave twice as many pixels of real objects
above the cost of the hypothesis search; twice as many change a tenth of these."""
WARM = Schedule(softened=0, judged=5)
"""Schedule from the normal and weights of a neighbour, or of the same pixel under nearly the same model."""


class Descent(NamedTuple):
    """The end of the descent of each sampled pixel."""

    normal: np.ndarray  # [n, 3] float32, unit
    cost: np.ndarray  # [n] float32, per light
    curvature: np.ndarray  # [n] float32, rise of the cost per light and squared radian, mean over all directions
    swing: np.ndarray  # [n] float32, how much more than its mean it rises where it rises most
    weights: np.ndarray  # [n, lobes] float32, of the mixture, for readings relative to the pixel's level

    def replace(self, where: np.ndarray, other: "Descent") -> np.ndarray:
        """Put in the pixels of another descent of m pixels that cost less, in place; return [m] bool, which were put in.

        `where` is [m], their positions among these pixels.
        """
        less = other.cost < self.cost[where]
        for whole, part in zip(self, other, strict=True):
            whole[where[less]] = part[less]
        return less


def descend(samples: Samples, start: np.ndarray, *, shape: LobeShape, options: SearchOptions | None = None,
            weights: np.ndarray | None = None, prior: Prior | None = None, schedule: Schedule = COLD) -> Descent:
    """Return the normal of least cost near the start of each sampled pixel, under lights of one direction each; waits for the device.

    Args:
        start: [n, 3] unit normals to begin from.
        weights: [n, lobes] of the mixture at the start; None: unknown.
        prior: normals that the result is drawn to, of which the costs include the cost; None: none.
        schedule: the turns; one without softened turns needs weights.
    """
    if start.shape != (samples.pixel_count, 3):
        raise ArrayError(f"start is {start.shape}: give one normal for each of the {samples.pixel_count} pixels")
    if weights is not None and weights.shape != (samples.pixel_count, MIXTURE):
        raise ArrayError(f"weights are {weights.shape}: give {MIXTURE} for each of the {samples.pixel_count} pixels")
    if weights is None and not schedule.softened:
        raise ArrayError("a descent without weights needs softened turns: give weights or another schedule")
    device, lanes, packs = samples.device, samples.lanes, samples.packs
    lane_type = pack_type(lanes, wp.float32)
    normal = per_pixel(samples, start)
    mixture = wp.zeros((MIXTURE, packs), dtype=lane_type, device=device) if weights is None else per_pixel(samples, weights)
    found = wp.empty((3, packs), dtype=lane_type, device=device)
    drawn = per_pixel(samples, start if prior is None else prior.normal)
    devices.launch(descent_kernel(lanes), packs,
                   [samples.arrays, drawn, prior_pull(prior), criteria(options, shape), wp.vec2(schedule.softness, schedule.cooling),
                    wp.vec2i(schedule.softened, schedule.softened + schedule.judged)],
                   [normal, mixture, found], device=device, uneven=True)
    cost, curvature, swing = to_host(samples, found).T
    return Descent(*(np.ascontiguousarray(values) for values in (to_host(samples, normal), cost, curvature, swing,
                                                                 to_host(samples, mixture))))
