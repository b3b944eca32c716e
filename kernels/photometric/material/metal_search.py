"""Normals of metals under the lobes that the object's metals share.

A metal shows nothing but its highlight. Where that falls between the lights, a pixel alone can trade the width of the lobe and its F0 for
a tilt of the normal by many degrees. With a lobe that other pixels of the metal determined, only the tilt is left: candidates around the
normal are tried under each shared metal, with the albedo free, and the best of them replaces the normal where it halves the cost.

Source: exemplars that an object shares, after Goldman et al., "Shape and spatially-varying BRDFs from photometric stereo", TPAMI 2010; the
candidates are those of `hypotheses`.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.material.material import BRIGHTEST_DIELECTRIC, COST_FLOOR, Material, fit_given
from kernels.photometric.model.candidates import LEAST_NZ, rings
from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.model.samples import Samples, to_host
from kernels.photometric.search.hypotheses import LobeShape

WIDE = ((4.0, 9.0, 15.0), 12)
"""Radii of the rings about the normal found so far, degrees, and the number of candidates on the last of them; under each metal."""
FINE = (2.0, 0.8, 0.3, 0.12)
"""Radii of the rings that follow, about the best candidate so far, under the metal that explains it best."""
FINE_COUNT = 6
"""Candidates on each of these."""
MOST_METALS = 2
"""Largest number of metals under which normals are searched."""
EXPLAINED = 25.0
"""Percentile of the costs of an object's metal pixels that counts as what a metal costs where it is explained."""
SAVED = 0.5
"""Part of its cost that a pixel must save to change its normal."""


class Metals(NamedTuple):
    """The metals of an object."""

    lobes: np.ndarray  # [metals, 4] F0 and roughness
    cost: float
    """Cost per light of a pixel that they explain."""


def metals_of(shared: np.ndarray, single: Material) -> Metals:
    """Return the shared materials that are metals, and what their pixels cost.

    Args:
        shared: [materials, 4] of shared_materials.choose_materials, the one that explains most first.
        single: material of some hundreds of pixels, spread over the object.
    """
    lobes = shared[shared[:, :3].max(axis=1) > BRIGHTEST_DIELECTRIC][:MOST_METALS]
    costs = single.cost[single.specular.max(axis=1) > BRIGHTEST_DIELECTRIC]
    return Metals(lobes, float(np.percentile(costs, EXPLAINED)) if len(costs) else 0.0)


def search_metals(samples: Samples, normal: np.ndarray, material: Material, metals: Metals, *, shape: LobeShape) -> np.ndarray:
    """Return the normals, [n, 3] float32, with those of metals replaced that a shared metal explains at less than half of the cost.

    `material` is what the given normals make of each pixel.
    """
    tried = np.flatnonzero(SAVED * material.cost > metals.cost + COST_FLOOR)
    if not len(tried) or not len(metals.lobes):
        return normal
    few, start = choose(samples, tried), normal[tried].astype(np.float64)
    view = to_host(few, few.view)
    found, cost, metal = start.copy(), np.full(len(tried), np.inf), np.zeros(len(tried), int)

    def improve(lobe: np.ndarray, which: int, where: np.ndarray, offsets: np.ndarray) -> None:
        """Try candidates about `start`, at the positions `where`, under one metal."""
        part = choose(few, where)
        for offset in offsets:
            candidate = moved(start[where], offset, view[where])
            trial = fit_given(part, candidate, lobe, shape=shape).cost
            lower = trial < cost[where]
            better = where[lower]
            found[better], cost[better], metal[better] = candidate[lower], trial[lower], which

    for which, lobe in enumerate(metals.lobes):
        improve(lobe, which, np.arange(len(tried)), rings(*WIDE))
    for degrees in FINE:
        start = found.copy()
        for which, lobe in enumerate(metals.lobes):
            if (where := np.flatnonzero(metal == which)).size:
                improve(lobe, which, where, rings((degrees,), FINE_COUNT)[1:])
    kept = cost < SAVED * material.cost[tried]
    replaced = normal.copy()
    replaced[tried[kept]] = found[kept]
    return replaced


def moved(normal: np.ndarray, offset: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Return unit normals [n, 3] at an offset of `rings`, moved along the view, [n, 3], where they would look away from the viewer."""
    sine, cosine, along, across = offset
    up = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(up, normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    candidate = cosine * normal + sine * (along * tangent + across * np.cross(normal, tangent))
    candidate += np.maximum(LEAST_NZ - (candidate * view).sum(axis=1, keepdims=True), 0) * view
    return candidate / np.linalg.norm(candidate, axis=1, keepdims=True)
