"""The few specular materials that the pixels of an object share, chosen from what single pixels found.

A pixel sees a highlight under a light or two, or under none, and cannot tell a faint wide lobe from a bright narrow one; another
pixel of the same material can. Candidates are materials that pixels found for themselves; the one that lowers the total cost most
is taken, then the one that lowers it most beside the first, and so on while it pays.

Source: materials as few and mixed per pixel, after Goldman et al., "Shape and spatially-varying BRDFs from photometric stereo",
TPAMI 2010; here lobes of Relit's BRDF with an albedo free in every pixel.
"""

import numpy as np

from kernels.photometric.hypotheses import Diffuse, SearchOptions
from kernels.photometric.material import fit_given, fit_material
from kernels.photometric.samples import Samples, evenly

CANDIDATES = 100
"""Number of pixels whose materials are candidates."""
MOST = 8
"""Largest number of shared materials."""
LEAST_GAIN = 0.01
"""Fraction of the total cost that a further material must save."""


def choose_materials(samples: Samples, normal: np.ndarray, *, shape: Diffuse, options: SearchOptions | None = None) -> np.ndarray:
    """Choose the materials that sampled pixels share.

    Args:
        samples: some hundreds of pixels, spread over the object.
        normal: [n, 3] unit normals.
        shape: of the diffuse lobe.
        options: noise and shadows, as in the search.

    Returns:
        [materials, 4] float32: F0 and roughness, the one that explains most first. Waits for the device.
    """
    own = fit_material(samples, normal, shape=shape, options=options)
    chosen = evenly(len(normal), CANDIDATES)
    candidates = np.concatenate([own.specular[chosen], own.roughness[chosen, None]], axis=1)
    costs = np.stack([fit_given(samples, normal, candidate, shape=shape, options=options).cost for candidate in candidates])
    materials: list[int] = []
    best = np.full(costs.shape[1], np.inf)
    while len(materials) < MOST:
        totals = np.minimum(costs, best).sum(axis=1)
        index = int(np.argmin(totals))
        if materials and best.sum() - totals[index] < LEAST_GAIN * best.sum():
            break
        materials.append(index)
        best = np.minimum(best, costs[index])
    return candidates[materials].astype(np.float32)
