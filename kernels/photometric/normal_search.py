"""The normal of least cost of each pixel: descents from a start, from the answers of neighbours and from the best of a survey.

One descent finds the answer of most pixels. Neighbours hand theirs on, the pixels that remain unexplained are surveyed for other modes, and
what is found there is handed on in turn.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.descent import Descent, descend
from kernels.photometric.hypotheses import Diffuse, Prior, SearchOptions
from kernels.photometric.propagation import STEPS, propagate
from kernels.photometric.samples import Samples
from kernels.photometric.survey import CLOSE, Survey, Sweep, survey


class Found(NamedTuple):
    """The answer of each sampled pixel, and what else its readings may mean."""

    best: Descent
    survey: Survey | None
    """The survey of the pixels that may have another mode; None: no pixel may."""


def find_normals(samples: Samples, start: np.ndarray, *, shape: Diffuse, options: SearchOptions | None = None,
                 beside: np.ndarray | None = None, prior: Prior | None = None, sweep: Sweep = CLOSE) -> Found:
    """Find the normal of least cost of each sampled pixel, under lights of one direction each.

    Args:
        samples: their readings.
        start: [n, 3] unit normals to begin from.
        shape: of the diffuse lobe.
        options: how normals are judged.
        beside: [steps, n] of propagation.neighbours; None: no pixel is another's neighbour.
        prior: normals that the results are drawn to, of which the costs include the cost; None: none.
        sweep: which pixels are surveyed, and how closely.

    Returns:
        The normals. Waits for the device.

    Raises:
        ArrayError: shapes that do not fit.
    """
    best = descend(samples, start, shape=shape, options=options, prior=prior)
    half = len(STEPS) // 2
    if beside is not None:
        propagate(samples, best, beside[:half], shape=shape, options=options, prior=prior)
    surveyed = survey(samples, best, shape=shape, options=options, prior=prior, sweep=sweep)
    if beside is not None:
        propagate(samples, best, beside[half:], shape=shape, options=options, prior=prior)
    return Found(best, surveyed)
