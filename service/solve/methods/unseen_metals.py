"""Metals in a solution that no pixel nearby shows: dielectrics in hollows, where hardly any light arrives.

Readings far below their prediction are taken for shadows, so a metal that stands where its highlights would all be in shadow explains the
dark readings of a hollow. A metal with a wrong normal does too, but lies among others that shine.
"""

import numpy as np
from scipy import ndimage

from kernels.photometric.material.albedo_error import albedo_error
from kernels.photometric.material.material import BRIGHTEST_DIELECTRIC
from kernels.photometric.material.shared_materials import best_dielectric
from service.solve.base.solution import Solution, half
from service.solve.methods.kinds import READ_AT_ONCE, Kinds, Read

WINDOW = 5
"""Side in pixels of the window over whose metals the light that they show is averaged."""
LEAST_SHOWN = 0.35
"""Share of the light of metals that pixels must show: right ones show 0.25 to 0.75 at the first percentile of pixels, dielectrics in
hollows that stand for one 0.1 in the median."""


def replace_unseen_metals(solution: Solution, shown: np.ndarray, shape: tuple[int, ...], kinds: Kinds, read: Read) -> np.ndarray:
    """Replace metals that pixels nearby do not show by the dielectrics of the object; return the positions of these pixels, [n].

    Args:
        solution: with F0, roughness and the errors of albedo; changed in place.
        shown: [pixels] share of the light of its material that a pixel shows.
        shape: rows and columns of the image.
        kinds: the materials that pixels share.
        read: returns the direct light of pixels.
    """
    assert solution.specular is not None and solution.roughness is not None
    assert solution.albedo_own is not None and solution.albedo_tilt is not None
    metal = (solution.specular.max(axis=0) > BRIGHTEST_DIELECTRIC).reshape(shape)
    if not metal.any():
        return np.zeros(0, int)
    total, count = (ndimage.uniform_filter(values, WINDOW, np.float32, mode="constant")
                    for values in (metal * shown.reshape(shape).astype(np.float32), metal))
    unseen = np.flatnonzero(metal & (total < LEAST_SHOWN * count))
    for start in range(0, len(unseen), READ_AT_ONCE):
        for at, kind, _ in kinds.groups(here := unseen[start:start + READ_AT_ONCE]):
            pixels = here[at]
            samples, normal = read(pixels), solution.normal[:, pixels].T
            found = best_dielectric(samples, normal, kind.materials, shape=kind.lobe)
            own, tilt = albedo_error(samples, normal, found, shape=kind.lobe, shared=kind.materials)
            solution.albedo[:, pixels], solution.specular[:, pixels] = half(found.diffuse_albedo.T), found.specular.T
            solution.roughness[pixels] = found.roughness
            solution.albedo_own[:, pixels], solution.albedo_tilt[:, pixels] = half(own.T), half(tilt.T)
    if len(unseen):
        solution.facts["unseen_metals"] = len(unseen)
    return unseen
