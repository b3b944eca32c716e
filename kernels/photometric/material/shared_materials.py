"""The few specular materials that the pixels of an object share, chosen from what single pixels found.

A pixel sees a highlight under a light or two, or under none, and cannot tell a faint wide lobe from a bright narrow one; another
pixel of the same material can. Candidates are materials that pixels found for themselves; the one that lowers the total cost most
is taken, then the one that lowers it most beside the first, and so on while it pays; a surface without a lobe comes first where no lobe
pays. The roughness of each is then moved to where the total is least. F0 of a dielectric follows from its refractive index alone, which
differs little between paints, plastics and skin, while a pixel trades F0 for roughness: so all dielectrics of the object have one F0 unless
F0 of their own pay.

Source: materials as few and mixed per pixel, after Goldman et al., "Shape and spatially-varying BRDFs from photometric stereo",
TPAMI 2010; here lobes of Relit's BRDF with an albedo free in every pixel.
"""

import numpy as np

from kernels.photometric.material.material import MATT, Material, fit_given, fit_material, is_dielectric
from kernels.photometric.material.material_kernel import ROUGHNESS_FIRST
from kernels.photometric.model.samples import Samples, evenly
from kernels.photometric.search.hypotheses import LobeShape

CANDIDATES = 100
"""Number of pixels whose materials are candidates."""
MOST = 8
"""Largest number of shared materials."""
LEAST_GAIN = 0.01
"""Fraction of the total cost that a further material must save, and each F0 beyond that which dielectrics have in common."""
LOBE_GAIN = 0.05
"""Fraction of the total cost that a lobe must save over none at all: in hollows, bounced light that is left in the readings passes for a
faint lobe, which saves up to 0.03; lobes of rough dielectrics save 0.07 and more."""
ROUGHNESS_STEPS = (0.06, 0.03, 0.015)
"""Steps by which the roughness of each chosen material is moved either way where that lowers the total cost: those of candidates scatter by
about the first, and pixels tell two roughnesses apart to about the last."""
LEAST_F0 = 0.005
"""Least F0 that dielectrics have in common: that of a refractive index of 1.15, below every solid."""
F0_GRID, F0_HALVINGS = 5, 4
"""Number of values of the common F0 that are tried between the least and the largest of the materials, evenly in its logarithm, and of
times that their step is halved about the best: three per cent from one to the next where the F0 differ by a factor of six."""


def choose_materials(samples: Samples, normal: np.ndarray, *, shape: LobeShape) -> np.ndarray:
    """Return [materials, 4] float32: F0 and roughness of the materials that sampled pixels share, in the order in which they were chosen.

    Waits for the device. The samples are some hundreds of pixels, spread over the object.
    """
    own = fit_material(samples, normal, shape=shape)
    chosen = evenly(len(normal), CANDIDATES)
    candidates = np.vstack([MATT, np.column_stack([own.specular[chosen], own.roughness[chosen]])])
    costs = np.stack([fit_given(samples, normal, candidate, shape=shape).cost for candidate in candidates])
    materials: list[int] = []
    best = np.full(costs.shape[1], np.inf)
    while len(materials) < MOST:
        totals = np.minimum(costs, best).sum(axis=1)
        index = int(np.argmin(totals[1:])) + 1
        if not materials and (1 - LOBE_GAIN) * totals[0] <= totals[index]:
            index = 0
        if materials and totals[index] > (1 - (LOBE_GAIN if materials == [0] else LEAST_GAIN)) * best.sum():
            break
        materials.append(index)
        best = np.minimum(best, costs[index])
    settled, least = _settle_roughness(samples, normal, candidates[materials].astype(np.float32), costs[materials], shape=shape)
    return _with_one_f0(samples, normal, settled, least, shape=shape)


def _settle_roughness(samples: Samples, normal: np.ndarray, materials: np.ndarray, costs: np.ndarray, *,
                      shape: LobeShape) -> tuple[np.ndarray, np.ndarray]:
    """Return the materials, [materials, 4], with the roughness at which the total cost beside the others is least, and their costs,
    [materials, n]."""
    materials, costs = materials.copy(), costs.copy()
    for step in ROUGHNESS_STEPS:
        for index in np.flatnonzero((materials != MATT).any(axis=1)):
            others = np.delete(costs, index, axis=0).min(axis=0, initial=np.inf)
            for moved in (-step, step):
                tried = materials[index].copy()
                tried[3] = np.clip(tried[3] + moved, ROUGHNESS_FIRST, 1)
                cost = fit_given(samples, normal, tried, shape=shape).cost
                if np.minimum(cost, others).sum(dtype=np.float64) < np.minimum(costs[index], others).sum(dtype=np.float64):
                    materials[index], costs[index] = tried, cost
    return materials, costs


def best_dielectric(samples: Samples, normal: np.ndarray, shared: np.ndarray | None, *, shape: LobeShape) -> Material:
    """Return the dielectric among the shared materials, [materials, 4], that explains each sampled pixel best, or a matt one if none is
    among them; waits for the device."""
    known = np.zeros((0, 4)) if shared is None else shared[is_dielectric(shared)]
    fits = [fit_given(samples, normal, lobe, shape=shape) for lobe in (known if len(known) else MATT[None])]
    best = np.argmin([fit.cost for fit in fits], axis=0)
    return Material(*(np.stack(planes)[best, np.arange(len(best))] for planes in zip(*fits, strict=True)))


def _with_one_f0(samples: Samples, normal: np.ndarray, materials: np.ndarray, costs: np.ndarray, *, shape: LobeShape) -> np.ndarray:
    """Return the materials with one F0 for all dielectrics, or as they are where F0 of their own save enough; `costs` is [materials, n]."""
    dielectric = is_dielectric(materials)
    dielectric[0] &= (materials[0] != MATT).any()  # which came first because the object is matt
    if dielectric.sum() < 2:
        return materials
    alike = materials[dielectric]
    low, high = np.log(np.maximum([alike[:, 0].min(), alike[:, 0].max()], LEAST_F0))
    if low == high:
        return materials
    others = costs[~dielectric].min(axis=0, initial=np.inf)
    tried: dict[float, float] = {}

    def judge(logarithm: float) -> None:
        if logarithm not in tried:
            cost = [fit_given(samples, normal, material, shape=shape).cost for material in _with_f0(alike, logarithm)]
            tried[logarithm] = float(np.minimum(np.min(cost, axis=0), others).sum(dtype=np.float64))

    for logarithm in np.linspace(low, high, F0_GRID):
        judge(float(logarithm))
    step = (high - low) / (F0_GRID - 1)
    for _ in range(F0_HALVINGS):
        step, best = 0.5 * step, min(tried, key=tried.__getitem__)
        judge(best - step)
        judge(best + step)
    best = min(tried, key=tried.__getitem__)
    if tried[best] > (1 + LEAST_GAIN * (len(alike) - 1)) * costs.min(axis=0).sum(dtype=np.float64):
        return materials
    shared = materials.copy()
    shared[dielectric] = _with_f0(alike, best)
    return shared


def _with_f0(materials: np.ndarray, logarithm: float) -> np.ndarray:
    """Return materials [materials, 4] with one F0, of which the logarithm is given."""
    return np.concatenate([np.full((len(materials), 3), np.exp(logarithm)), materials[:, 3:]], axis=1).astype(np.float32)
