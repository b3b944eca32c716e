"""Doubt of normals whose dielectric shines far more than the object's other dielectrics.

Towards the rim, and where bounced light fills the shadows, a pixel can trade a tilt of its normal for an F0. Where a tilted normal with the
F0 that the object shares explains the readings about as well, the readings do not tell which is right, and the angle between both normals
belongs to the standard deviation.
"""

import numpy as np

from kernels.photometric.candidates import rings
from kernels.photometric.hypotheses import Diffuse
from kernels.photometric.material import Material, explains, fit_given_f0, is_dielectric, outlying
from kernels.photometric.metal_search import moved
from kernels.photometric.samples import Samples, choose, to_host

RINGS = (2.0, 0.8, 0.3, 0.12)
"""Radii in degrees of the rings of candidates, each about the best so far."""
RING_COUNT = 6
"""Candidates on each of them."""


def doubt_of_f0(samples: Samples, normal: np.ndarray, material: Material, shared: np.ndarray, *, shape: Diffuse) -> np.ndarray:
    """Return the angle in degrees, [n] float32, to a normal that explains the pixel about as well with the shared F0.

    It is 0 where F0 is not far above the shared ones, and where no such normal was found.

    Args:
        samples: readings.
        normal: [n, 3] unit normals.
        material: of material.fit_material.
        shared: [materials, 4] F0 and roughness of shared_materials.choose_materials.
        shape: of the diffuse lobe.
    """
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
