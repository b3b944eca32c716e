"""Normals from a table of readings measured on a ball of the same material.

The search of `hypotheses` with one lobe, the ball's, at every candidate normal; its weight is how bright the pixel is beside the
ball, so albedo may vary and the kind of reflectance may not. What the ball leaves unexplained on all pixels is the noise of the posterior:
a ball of another material widens it.

Source: Woodham, "Photometric method for determining surface orientation from multiple images", Optical Engineering 1980
(lookup table from a calibration sphere); Hertzmann and Seitz, "Example-based photometric stereo", TPAMI 2005.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.errors import ArrayError
from kernels.photometric.hypotheses import Diffuse, search_normals
from kernels.photometric.modes import find_modes, weigh
from kernels.photometric.posterior import Group, bounded, measure_noise, normal_posterior
from kernels.photometric.response_table import GRID
from kernels.photometric.samples import Samples
from kernels.photometric.sampling import AROUND, AROUND_OPTIONS, FINE, OPTIONS


class ReferenceFit(NamedTuple):
    """Normal of each sampled pixel, on the host."""

    normal: np.ndarray  # [n, 3] float32, unit
    confidence: np.ndarray  # [n] float32: probability of the mode / (1 + its standard deviation / 1°)
    sigma: np.ndarray  # [n] float32: standard deviation of the normal over its modes, degrees
    residual: np.ndarray  # [n] float32: root of the mean cost per light, in units of the noise
    excess: np.ndarray  # [n] float32: the square of what the ball leaves unexplained over the noise of the object's readings


def reference_table(readings: np.ndarray, device: str) -> wp.array:
    """Return a table of the readings of the ball at each of response_table.nodes.

    Args:
        readings: [GRID², lights] not negative.
        device: where.

    Returns:
        [GRID², lights, 1] float32 on the device.

    Raises:
        ArrayError: readings at other nodes, or none above zero.
    """
    if readings.ndim != 2 or len(readings) != GRID * GRID:
        raise ArrayError(f"readings are {readings.shape}: give one row for each of the {GRID * GRID} nodes")
    if not (readings >= 0).all() or not readings.any():
        raise ArrayError("readings of the ball must not be negative, and some must be above zero")
    return wp.array(readings[..., None], dtype=wp.float32, device=device)


def solve_reference(samples: Samples, table: wp.array, view: np.ndarray) -> ReferenceFit:
    """Estimate the normals of sampled pixels.

    Args:
        samples: their readings, in the units of the ball's.
        table: of the same lights.
        view: [n, 3] unit directions to the viewer.

    Returns:
        The fit. Waits for the device.

    Raises:
        ArrayError: shapes that do not fit.
    """
    model = bounded(table, samples)
    starts = find_modes(samples, model, view)
    near = [search_normals(samples, start, shape=Diffuse(), options=AROUND_OPTIONS, wide=AROUND[0], fine=AROUND[1:], table=table).normal
            for start in starts]
    found = search_normals(samples, near[0], shape=Diffuse(), options=OPTIONS, wide=FINE[0], fine=FINE[1:], table=table)
    first = Group(samples, model, found.normal)
    noise = measure_noise([first])
    modes = weigh(normal_posterior(first, noise), normal_posterior(first._replace(normal=near[1]), noise))
    normal = np.where(modes.close_to(found.normal)[:, None], found.normal, modes.normal)
    return ReferenceFit(normal, (modes.probability / (1 + modes.sigma)).astype(np.float32), modes.spread, np.sqrt(found.cost),
                        modes.excess)
