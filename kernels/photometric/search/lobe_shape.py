"""The shape of the lobes that the pixels of an object share, chosen by how well the object is explained as a whole.

Real diffuse reflection is darker than Lambert's at grazing angles on smooth plastics and brighter on rough ceramics. A pixel alone
cannot tell that shape from a tilt of its normal; all pixels together can: the shape with the least total cost of the
hypothesis search is also the one with the least error of the normals (docs/figures.md). So do they tell whether highlights have the long
tails of GGX or hardly any, as Beckmann's: no sum of lobes with tails is one without.

Source: the diffuse lobe is Burley's, "Physically-based shading at Disney", 2012, section 5.3; choosing its shape by cost is ours.
"""

import itertools
from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import Samples
from kernels.photometric.search.descent import Schedule, descend
from kernels.photometric.search.hypotheses import LobeShape
from kernels.photometric.search.normal_search import find_normals
from kernels.photometric.search.survey import QUICK

ROUGHNESSES = (-1.0, 0.05, 0.2, 0.35, 0.5, 0.65, 0.8)
"""Roughnesses of Burley's lobe that are tried; the value below 0 stands for Lambert's lobe."""
SLOPES = (-0.3, -0.2, -0.1, 0.0, 0.1)
"""Slopes of the lobe's further factor that are tried."""
REFINEMENT = 0.5
"""Step of the second search, about the best shape of the first, as a fraction of the first search's step."""
FROM_LAMBERT = Schedule(softened=0, judged=7)
"""Descent from the normal and weights found under Lambert's lobe: another shape moves normals by a few degrees."""
SIMPLER = 1.01
"""Factor on the least cost up to which Lambert's lobe, with a slope or without, is kept."""
SHORT = 0.8
"""Part of the cost under GGX's lobes to which short tails must lower it: real objects cost .95 to 1.02 of it, path-traced paint under GGX
.93 to 1.07, and under Beckmann's distribution .3 to .97, more where light bounces; of metals under GGX some cost .6, and their
normals are better too."""
TEMPERATURE = 0.07
"""Softmax temperature of the average over shapes, relative to the least cost. Costs a few per cent apart do not tell shapes apart: with the
shape of least cost alone, the normals of a real ball are 0.07 degrees worse."""


class Shapes(NamedTuple):
    """The shape of the lobes of an object."""

    best: LobeShape
    """The shape of least cost, under which materials are fitted."""
    mean: LobeShape
    """The mean of the shapes that cost little, under which normals are found: a wrong shape bends them, and the mean errs less."""
    tried: dict[LobeShape, float]
    """The mean cost of each shape."""


def choose_lobe_shape(samples: Samples, start: np.ndarray, *, beside: LobeShape | None = None,
                      short_tails: bool | None = None) -> Shapes:
    """Choose the shape of the lobes from some hundreds of pixels, spread over the object; waits for the device.

    `start` is [n, 3] unit normals to begin from. `beside` is a further shape that is tried. `short_tails`: whether highlights have them;
    None: these pixels tell.
    """
    first = find_normals(samples, start, shape=LobeShape(short_tails=short_tails is True), sweep=QUICK).best

    def cost_of(shape: LobeShape) -> float:
        found = descend(samples, first.normal, shape=shape, weights=first.weights, schedule=FROM_LAMBERT)
        return float(np.mean(found.cost, dtype=np.float64))

    if short_tails is None:
        short_tails = cost_of(LobeShape(short_tails=True)) < SHORT * float(np.mean(first.cost, dtype=np.float64))
        if short_tails:
            first = find_normals(samples, start, shape=LobeShape(short_tails=True), sweep=QUICK).best
    tried: dict[LobeShape, float] = {} if beside is None else {beside: cost_of(beside)}

    def judge(rough: float, slope: float) -> None:
        shape = LobeShape(rough=round(rough, 4), slope=round(slope, 4), short_tails=short_tails)
        if shape not in tried:
            tried[shape] = cost_of(shape)

    for rough, slope in itertools.product(ROUGHNESSES, SLOPES):
        judge(rough, slope)
    best = _best(tried)
    rough_step, slope_step = ROUGHNESSES[2] - ROUGHNESSES[1], SLOPES[1] - SLOPES[0]
    for across, along in itertools.product((-1, 0, 1), repeat=2):
        rough = best.rough if best.rough < 0 else float(np.clip(best.rough + across * REFINEMENT * rough_step, 0, 1))
        judge(rough, best.slope + along * REFINEMENT * slope_step)
    best = _best(tried)
    return Shapes(best, _average(tried, best), tried)


def _best(tried: dict[LobeShape, float]) -> LobeShape:
    """Return the shape of least cost, or the best slope of Lambert's lobe where that costs hardly more."""
    best = min(tried, key=tried.__getitem__)
    lambert = min((shape for shape in tried if shape.rough < 0), key=tried.__getitem__)
    return lambert if tried[lambert] <= SIMPLER * tried[best] else best


def _average(tried: dict[LobeShape, float], best: LobeShape) -> LobeShape:
    """Return the mean of the shapes of the best one's lobe, Lambert's or Burley's, each weighted by how little it costs."""
    alike = np.array([(shape.rough, shape.slope, cost) for shape, cost in tried.items()
                      if (shape.rough < 0, shape.short_tails) == (best.rough < 0, best.short_tails)])
    least = alike[:, 2].min()
    weights = np.exp(-(alike[:, 2] - least) / max(TEMPERATURE * least, 1e-12))
    rough, slope = weights @ alike[:, :2] / weights.sum()
    return LobeShape(rough=round(float(rough), 4), slope=round(float(slope), 4), short_tails=best.short_tails)
