"""The normal of least cost of each pixel: descents from a start, from the answers of neighbours and from the best of a survey.

One descent finds the answer of most pixels. Neighbours hand theirs on, the pixels that remain unexplained are surveyed for other modes, and
what is found there is handed on in turn.

Descents end in different minima at neighbouring pixels, of which the surface and its material are nearly the same. Where a neighbour costs
clearly less, its answer is a start for a descent of a few turns; this is done direction by direction, so that an answer travels.

Source: Barnes, Shechtman, Finkelstein and Goldman, "PatchMatch: a randomized correspondence algorithm for structural image editing",
SIGGRAPH 2009, section 3.2 (propagation).
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.model.samples import Samples
from kernels.photometric.search.descent import WARM, Descent, descend
from kernels.photometric.search.hypotheses import LobeShape, Prior, SearchOptions
from kernels.photometric.search.survey import CLOSE, Survey, Sweep, survey

STEPS = ((0, 2), (2, 0), (0, -2), (-2, 0), (3, 3), (-3, 3), (3, -3), (-3, -3))
"""Rows and columns to the neighbours: far enough for another answer, near enough for the same surface."""
CLEARLY_LESS = 0.7
"""Part of a pixel's cost that its neighbour's may have to be tried. At 0.8 a third more pixels are tried, of which few gain."""
LEAST_COST = 0.005
"""Cost per light below which a pixel needs no other answer: that of a residual of 0.07 σ at every light."""
LEAST_TRIED = 32
"""Fewer pixels are not worth a launch."""


def neighbours(pixels: np.ndarray, width: int) -> np.ndarray:
    """Return [steps, n] int32, the neighbours of chosen pixels as positions in `pixels`, -1 where the neighbour is not among them.

    `pixels` are [n] row-major positions in an image of this width, ascending.
    """
    found = np.full((len(STEPS), len(pixels)), -1, dtype=np.int32)
    if not len(pixels):
        return found
    columns = pixels % width
    steps = [down * width + right for down, right in STEPS]
    first = int(pixels[0]) + min(steps)
    place = np.full(int(pixels[-1]) + max(steps) - first + 1, -1, dtype=np.int32)  # of each pixel of the image about the chosen ones
    place[pixels - first] = np.arange(len(pixels), dtype=np.int32)
    for step, (_, right) in enumerate(STEPS):
        inside = (columns + right >= 0) & (columns + right < width)
        found[step] = np.where(inside, place[pixels - first + steps[step]], -1)
    return found


def propagate(samples: Samples, found: Descent, beside: np.ndarray, *, shape: LobeShape, options: SearchOptions | None = None,
              prior: Prior | None = None) -> None:
    """Replace the answers of pixels that a start from a neighbour's answer betters, in place.

    `beside` is [steps, n] of `neighbours`, or some of its rows.
    """
    for neighbour in beside:
        better = (neighbour >= 0) & (found.cost[neighbour] < CLEARLY_LESS * found.cost) & (found.cost > LEAST_COST)
        tried = np.flatnonzero(better)
        if len(tried) < LEAST_TRIED:
            continue
        giving = neighbour[tried]
        drawn = None if prior is None else prior._replace(normal=prior.normal[tried])
        found.replace(tried, descend(choose(samples, tried), found.normal[giving], shape=shape, options=options,
                                     weights=found.weights[giving], prior=drawn, schedule=WARM))


class Found(NamedTuple):
    """The answer of each sampled pixel, and what else its readings may mean."""

    best: Descent
    survey: Survey | None
    """The survey of the pixels that may have another mode; None: no pixel may."""


def find_normals(samples: Samples, start: np.ndarray, *, shape: LobeShape, options: SearchOptions | None = None,
                 beside: np.ndarray | None = None, prior: Prior | None = None, sweep: Sweep = CLOSE) -> Found:
    """Find the normal of least cost of each sampled pixel, under lights of one direction each; waits for the device.

    Args:
        start: [n, 3] unit normals to begin from.
        beside: [steps, n] of `neighbours`; None: no pixel is another's neighbour.
        prior: normals that the results are drawn to, of which the costs include the cost; None: none.
        sweep: which pixels are surveyed, and how closely.
    """
    best = descend(samples, start, shape=shape, options=options, prior=prior)
    half = len(STEPS) // 2
    if beside is not None:
        propagate(samples, best, beside[:half], shape=shape, options=options, prior=prior)
    surveyed = survey(samples, best, shape=shape, options=options, prior=prior, sweep=sweep)
    if beside is not None:
        propagate(samples, best, beside[half:], shape=shape, options=options, prior=prior)
    return Found(best, surveyed)
