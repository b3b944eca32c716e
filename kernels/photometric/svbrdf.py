"""The general solver: normal, diffuse albedo, F0 and roughness of each pixel, without learning.

Normals come from `normal_search` under the diffuse shape that the object shares, from descents under shapes close to it, and from the
joint fit of a single lobe; they are averaged, each weighted by how well it explains the pixel, first those of the mixture under all shapes
and then their mean and that of the single lobe. The material then follows for the normal found.

Towards the rim, and where bounced light fills the shadows, a pixel can trade a tilt of its normal for an F0. Where a tilted normal with the
F0 that the object's dielectrics share explains a far brighter pixel about as well, the angle between both normals belongs to the standard
deviation.

Sources: Relit's BRDF is GGX (Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007) with Smith's
height-correlated masking (Heitz, "Understanding the masking-shadowing function", JCGT 2014), Schlick's Fresnel ("An inexpensive BRDF
model for physically-based rendering", Computer Graphics Forum 1994) and Burley's diffuse lobe (2012); the cost of normals is
that of `hypotheses`, after Hui and Sankaranarayanan, TPAMI 2017. Averaging the normals of several models is ours.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kernels.photometric.material.material import (
    MATT,
    Material,
    explains,
    fit_given,
    fit_given_f0,
    fit_material,
    fit_tinted,
    is_dielectric,
    outlying,
)
from kernels.photometric.material.metal_search import Metals, moved, search_metals
from kernels.photometric.material.mixtures import NO_PAIRS, Mixture, mix_materials
from kernels.photometric.model.candidates import rings
from kernels.photometric.model.chosen_samples import choose, put
from kernels.photometric.model.samples import Samples, to_host
from kernels.photometric.search.certainty import SingleLobe, standard_deviation
from kernels.photometric.search.descent import WARM, descend
from kernels.photometric.search.hypotheses import LobeShape, Prior
from kernels.photometric.search.lobe_shape import UNKNOWN_SPREAD, ShapeSpread
from kernels.photometric.search.normal_search import find_normals
from kernels.photometric.search.refine import refine
from kernels.photometric.search.shared_misfit import UNKNOWN_SHARE

NEIGHBOURS = ((-0.15, 0.0, 0.0), (0.15, 0.0, 0.0), (0.0, -0.1, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, -0.15), (0.0, 0.0, 0.15))
"""Differences in roughness, slope and facets of the shapes that are tried besides the shared one: a material varies by as much over an
object. A roughness below 0 is left out: the lobe of roughness 0 in its place costs least on real objects and has worse normals."""
SHAPE_TEMPERATURE, KIND_TEMPERATURE = 0.8, 0.2
"""Softmax temperatures of the averages over shapes, and over the mixture and the single lobe, relative to the best cost: a model whose cost
is this fraction above the best has 1/e of its weight. Costs of shapes differ by misfit alone, and what it bends cancels in their mean; a
single lobe that costs clearly less than the mixture is the sharper model."""
SINGLE_LOBE_CHARGE = 1.5
"""Factor on the cost of the single lobe: to replace the mixture, the single lobe must explain a pixel clearly better, as it does on
metals."""


class SvbrdfFit(NamedTuple):
    """Normal and material of each sampled pixel, on the host."""

    normal: np.ndarray  # [n, 3] float32, unit
    diffuse_albedo: np.ndarray  # [n, 3] float32
    specular: np.ndarray  # [n, 3] float32, F0
    roughness: np.ndarray  # [n] float32
    sigma: np.ndarray  # [n] float32, standard deviation of the normal, degrees
    residual: np.ndarray  # [n] float32: root of the mean cost per light, in units of the noise
    mixture: Mixture  # of pixels with two materials; F0 and roughness above are then those of one lobe close to both


def solve_svbrdf(samples: Samples, start: np.ndarray, *, shape: LobeShape, lobe: LobeShape | None = None,
                 shared: np.ndarray | None = None, pairs: np.ndarray = NO_PAIRS,
                 metals: Metals | None = None, roughness: np.ndarray | None = None, single_lobe: bool = True, prior: Prior | None = None,
                 beside: np.ndarray | None = None, shared_misfit: float = UNKNOWN_SHARE,
                 shape_spread: ShapeSpread = UNKNOWN_SPREAD) -> SvbrdfFit:
    """Estimate the normal and the material of sampled pixels; waits for the device.

    Args:
        start: [n, 3] unit normals to begin from, within some 50° of the truth.
        lobe: the shape under which materials are fitted; None: the same.
        shared: [materials, 4] of shared_materials.choose_materials; None: every pixel has a material of its own.
        pairs: [pairs, 2, 4] of mixtures.choose_pairs.
        metals: of metal_search.metals_of; None: normals are not searched under shared metals.
        roughness: [n] of an earlier fit, from which the single lobe begins; None: it is fitted first.
        single_lobe: False leaves the joint fit of one lobe out, to see what it buys.
        prior: normals to which the search is drawn, because the readings do not support the lobes; then the joint fit, which knows no
            prior, is left out, and the surface is taken as Lambertian.
        beside: [steps, n] of normal_search.neighbours; None: no pixel is another's neighbour.
        shared_misfit: share of the misfit that neighbouring pixels have in common, of shared_misfit.shared_misfit.
        shape_spread: of the shapes that `shape` is the mean of.
    """
    lobe = shape if lobe is None else lobe
    found = find_normals(samples, start, shape=shape, beside=beside, prior=prior)
    normals, costs, others = [found.best.normal], [found.best.cost], nearby_shapes(shape)
    for nearby in others:
        other = descend(samples, found.best.normal, shape=nearby, weights=found.best.weights, prior=prior, schedule=WARM)
        normals.append(other.normal)
        costs.append(other.cost)
    steps = [(nearby.rough - shape.rough, nearby.slope - shape.slope, nearby.facets - shape.facets) for nearby in others]
    doubt = doubt_of_shape(np.stack(normals), steps, shape_spread.errors(shared_misfit))
    normal, _ = average_normals(np.stack(normals), np.stack(costs), temperature=SHAPE_TEMPERATURE)
    spread = np.zeros_like(doubt)
    lone = None
    if single_lobe and prior is None:
        if roughness is None:
            roughness = fit_tinted(samples, found.best.normal, shape=shape).roughness
        single = refine(samples, found.best.normal, roughness, shape=shape)
        kinds = np.stack([np.min(costs, axis=0), SINGLE_LOBE_CHARGE * single.cost])
        normal, spread = average_normals(np.stack([normal, single.normal]), kinds, temperature=KIND_TEMPERATURE)
        lone = SingleLobe(model_weights(kinds, temperature=KIND_TEMPERATURE)[1], single.cost, single.openness)
    if prior is None:
        material = fit_material(samples, normal, shape=lobe, shared=shared)
        if metals is not None:
            better = search_metals(samples, normal, material, metals, shape=lobe)
            moved = np.flatnonzero((better != normal).any(axis=1))
            if len(moved):
                again = fit_material(choose(samples, moved), better[moved], shape=lobe, shared=shared)
                put(material, moved, again)
                spread = np.hypot(spread, _angles(normal, better))
                normal = better
    else:
        material = fit_given(samples, normal, MATT, shape=lobe)
        found = find_normals(samples, normal, shape=shape)  # the readings alone say how sure the normal is
        spread = np.hypot(spread, _angles(found.best.normal, normal))
    material, mixture = mix_materials(samples, normal, material, pairs, shape=lobe)
    if shared is not None:
        spread = np.hypot(spread, doubt_of_f0(samples, normal, material, shared, shape=lobe))
    sigma = standard_deviation(samples, found, normal, spread, doubt, lone, shared_misfit)
    return SvbrdfFit(normal, material.diffuse_albedo, material.specular, material.roughness, sigma,
                     np.sqrt(found.best.cost), mixture)


def nearby_shapes(shape: LobeShape) -> list[LobeShape]:
    """Return the shapes that are tried besides one; Lambert's lobe has no roughness that could differ, and no facets."""
    return [replace(shape, rough=shape.rough + rough, slope=shape.slope + slope, facets=max(shape.facets + facets, 0.0))
            for rough, slope, facets in NEIGHBOURS if (not rough or shape.rough + rough >= 0) and (not facets or shape.facets)]


def model_weights(costs: np.ndarray, *, temperature: float) -> np.ndarray:
    """Return the weights of models in a pixel's average, [models, n], from their costs, [models, n]: exp(-(cost - best) / (temperature ·
    best)) over their sum."""
    best = costs.min(axis=0)
    weights = np.exp(-(costs - best) / np.maximum(temperature * best, 1e-6))
    return np.asarray(weights / weights.sum(axis=0))


def doubt_of_shape(normals: np.ndarray, steps: list[tuple[float, ...]], errors: tuple[float, ...]) -> np.ndarray:
    """Return the standard errors in degrees, [n] float32, that normals have because the shape of the lobes is not known exactly.
    `normals`: [1 + steps, n, 3] unit, under the shape and under others. `steps`: what the others differ by, in roughness, slope or facets.
    `errors`: of the shape, in each of these."""
    variance = np.zeros(normals.shape[1], np.float32)
    for axis, sigma in enumerate(errors):
        turned = [(_angles(normals[0], other) / step[axis]) ** 2 for other, step in zip(normals[1:], steps, strict=True) if step[axis]]
        if turned:
            variance += sigma**2 * np.mean(turned, axis=0)
    return np.sqrt(variance)


def average_normals(normals: np.ndarray, costs: np.ndarray, *, temperature: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of a pixel's normals under several models, by `model_weights`, and their weighted RMS spread in degrees.
    `normals`: [models, n, 3] unit. `costs`: [models, n]."""
    weights = model_weights(costs, temperature=temperature)
    mean = np.einsum("sn,snc->nc", weights, normals)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    spread = np.sqrt(np.einsum("sn,sn->n", weights, _angles(normals, mean) ** 2))
    return mean.astype(np.float32), spread.astype(np.float32)


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles in degrees between unit vectors along the last axis."""
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))


RINGS = (2.0, 0.8, 0.3, 0.12)
"""Radii in degrees of the rings of candidates, each about the best so far."""
RING_COUNT = 6
"""Candidates on each of them."""


def doubt_of_f0(samples: Samples, normal: np.ndarray, material: Material, shared: np.ndarray, *, shape: LobeShape) -> np.ndarray:
    """Return the angle in degrees, [n] float32, to a normal that explains the pixel about as well with the shared F0.

    It is 0 where F0 is not far above the shared ones, and where no such normal was found.
    `material`: of material.fit_material. `shared`: [materials, 4] F0 and roughness of shared_materials.choose_materials."""
    doubt = np.zeros(len(normal), np.float32)
    common = shared[is_dielectric(shared), 0]
    if not len(common):
        return doubt
    lobes = np.column_stack([material.specular, material.roughness])
    at = np.flatnonzero(is_dielectric(lobes) & outlying(material.specular, common))
    if not len(at):
        return doubt
    few, best = choose(samples, at), normal[at].astype(np.float64)
    view = to_host(few, few.view)
    least = fit_given_f0(few, normal[at], float(common.max()), shape=shape)
    for degrees in RINGS:
        middle = best.copy()
        for offset in rings((degrees,), RING_COUNT)[1:]:
            candidate = moved(middle, offset, view)
            trial = fit_given_f0(few, candidate, float(common.max()), shape=shape)
            lower = trial.cost < least.cost
            best[lower], least.cost[lower] = candidate[lower], trial.cost[lower]
    known = Material(*(plane[at] for plane in material))
    angle = np.degrees(np.arccos(np.clip((best * normal[at]).sum(axis=1), -1, 1)))
    doubt[at] = np.where(explains(least, known), angle, 0)
    return doubt
