"""The shape of the lobes that the pixels of an object share, chosen by how well the object is explained as a whole.

Real diffuse reflection is darker than Lambert's at grazing angles on smooth plastics and brighter on rough ceramics. A pixel alone
cannot tell that shape from a tilt of its normal; all pixels together can: the shape with the least total cost of the
hypothesis search is also the one with the least error of the normals (docs/figures.md). So do they tell whether highlights have the long
tails of GGX or hardly any, as Beckmann's: no sum of lobes with tails is one without.

Sources: the diffuse lobe is Burley's, "Physically-based shading at Disney", 2012, section 5.3, or Oren's and Nayar's, "Generalization of
Lambert's reflectance model", SIGGRAPH 1994, as of stone, clay and plaster; choosing its shape by cost is ours.
"""

import itertools
import math
from dataclasses import replace
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
FACETS = (0.2, 0.4, 0.6)
"""Ratios B/A of Oren's and Nayar's lobe that are tried, with FACET_SLOPES: facets of 14°, 27° and 47°."""
FACET_SLOPES = (-0.1, 0.0, 0.1)
"""Slopes of the further factor that are tried with facets."""
ROUGH_STEP, SLOPE_STEP, FACET_STEP = 0.075, 0.05, 0.1
"""Steps of the second search, about the best shape of the first."""
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


SHAPE_SHARE = 4.0
"""Part of the spread of shapes, squared, that is the error of their mean, up to the whole, for each share of the misfit that neighbouring
pixels have in common: real objects, of lobes that none of the shapes has, share .26 to .33; of path-traced ones with .01 to .04 the misfit
is noise, which the pixels average, and their shape is known better than costs of a single pixel say."""


ROUNDED = 1 / math.sqrt(12)
"""Standard error, in steps of the second search, of a shape on its grid."""
HALVES = (0.5, 0.25, 0.125)
"""Parts of a step by which the slope of Lambert's lobe is moved to either side where costs tell it: half a step turns the normals of a
clean object by 0.2°."""
NARROW = ROUNDED / 4
"""Standard error, in steps, of a slope that was found so."""


class ShapeSpread(NamedTuple):
    """How far the shapes that cost little are apart."""

    rough: float
    """Standard deviation of the roughness of their diffuse lobes."""
    slope: float
    """That of the slope of the further factor."""
    facets: float
    """That of the ratio of facets."""
    rounding: float = ROUNDED
    """Standard error because shapes are tried in steps, of these."""

    def errors(self, shared: float) -> tuple[float, ...]:
        """Return the standard errors of roughness, slope and facets of their mean. `shared`: 0…1, of `shared_misfit`."""
        part = math.sqrt(min(1.0, SHAPE_SHARE * shared))
        return tuple(math.hypot(part * spread, self.rounding * step)
                     for spread, step in zip(self[:3], (ROUGH_STEP, SLOPE_STEP, FACET_STEP), strict=True))


UNKNOWN_SPREAD = ShapeSpread(0.1, 0.05, 0.1)
"""That of a shape that is not chosen from the object: about the mean of those that are."""


class Shapes(NamedTuple):
    """The shape of the lobes of an object."""

    best: LobeShape
    """The shape of least cost, under which materials are fitted."""
    mean: LobeShape
    """The mean of the shapes that cost little, under which normals are found: a wrong shape bends them, and the mean errs less."""
    spread: ShapeSpread
    """That of these shapes about their mean."""
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

    def judge(rough: float, slope: float, facets: float = 0.0) -> None:
        shape = LobeShape(rough=round(rough, 4), slope=round(slope, 4), short_tails=short_tails, facets=round(facets, 4))
        if shape not in tried:
            tried[shape] = cost_of(shape)

    for rough, slope in itertools.product(ROUGHNESSES, SLOPES):
        judge(rough, slope)
    for facets, slope in itertools.product(FACETS, FACET_SLOPES):
        judge(-1.0, slope, facets)
    best = _best(tried)
    for across, along in itertools.product((-1, 0, 1), repeat=2):
        rough = best.rough if best.rough < 0 else float(np.clip(best.rough + across * ROUGH_STEP, 0, 1))
        facets = max(best.facets + across * FACET_STEP, 0.0) if best.facets else 0.0
        judge(rough, best.slope + along * SLOPE_STEP, facets)
    best = _best(tried)
    mean, spread = _average(tried, best)
    if best.rough < 0 and not best.facets and spread.slope < SLOPE_STEP:
        mean, least = best, tried[best]
        for part in HALVES:
            for slope in (mean.slope - part * SLOPE_STEP, mean.slope + part * SLOPE_STEP):
                cost = cost_of(between := replace(best, slope=round(slope, 4)))
                if cost < least:
                    mean, least = between, cost
        spread = spread._replace(rounding=NARROW)
    return Shapes(best, mean, spread, tried)


def _best(tried: dict[LobeShape, float]) -> LobeShape:
    """Return the shape of least cost, or the best slope of Lambert's lobe where that costs hardly more."""
    best = min(tried, key=tried.__getitem__)
    lambert = min((shape for shape in tried if shape.rough < 0 and not shape.facets), key=tried.__getitem__)
    return lambert if tried[lambert] <= SIMPLER * tried[best] else best


def _average(tried: dict[LobeShape, float], best: LobeShape) -> tuple[LobeShape, ShapeSpread]:
    """Return the mean of the shapes of the best one's kind of lobe (Lambert's, Burley's, facets), each weighted by how little it costs, and
    their spread about it."""
    def kind(shape: LobeShape) -> tuple[bool, bool, bool]:
        return shape.rough < 0, shape.facets > 0, shape.short_tails

    alike = np.array([(shape.rough, shape.slope, shape.facets, cost) for shape, cost in tried.items() if kind(shape) == kind(best)])
    least = alike[:, 3].min()
    weights = np.exp(-(alike[:, 3] - least) / max(TEMPERATURE * least, 1e-12))
    weights /= weights.sum()
    mean = weights @ alike[:, :3]
    spread = ShapeSpread(*np.sqrt(weights @ (alike[:, :3] - mean) ** 2).tolist())
    rough, slope, facets = mean.round(4).tolist()
    return LobeShape(rough=rough, slope=slope, short_tails=best.short_tails, facets=facets), spread
