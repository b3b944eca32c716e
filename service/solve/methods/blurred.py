"""Blurred metals in a solution: pixels whose material loses most of their light, beside others that do or are metals."""

import numpy as np
from scipy import ndimage

from kernels.photometric.material.blurred_metals import find_blurred_metals
from kernels.photometric.material.material import BRIGHTEST_DIELECTRIC
from service.solve.base.solution import Solution
from service.solve.methods.kinds import READ_AT_ONCE, Read

EIGHT = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
"""The neighbours of a pixel."""
LEAST_METALS = 3
"""Neighbours, of eight, that are metals or lose light too, beside which a pixel that loses light may be one: single pixels that do lie in
grooves."""
LESS_MISREAD = 0.75
"""Part to which a metal must lower the share of the light that is misread, or all light."""


def place_blurred_metals(solution: Solution, misread: np.ndarray, shape: tuple[int, ...], read: Read) -> np.ndarray:
    """Replace what was found of pixels by blurred metals that explain more of their light; return the positions of these pixels, [n].

    Args:
        solution: with F0 and roughness; changed in place.
        misread: [pixels] share of the light that is misread, 0 of pixels whose material accounts for it.
        shape: rows and columns of the image.
        read: returns the direct light of pixels.
    """
    assert solution.specular is not None and solution.roughness is not None
    bright = (misread > 0) | (solution.specular.max(axis=0) > BRIGHTEST_DIELECTRIC)
    around = ndimage.convolve(bright.reshape(shape).astype(np.uint8), EIGHT, mode="constant").reshape(-1)
    tried = np.flatnonzero((misread > 0) & (around >= LEAST_METALS))
    changed = [np.zeros(0, int)]
    for start in range(0, len(tried), READ_AT_ONCE):
        pixels = tried[start:start + READ_AT_ONCE]
        metal = find_blurred_metals(read(pixels))
        less = metal.misread < LESS_MISREAD * np.minimum(misread[pixels], 1)
        pixels = pixels[less]
        solution.normal[:, pixels], solution.sigma[pixels] = metal.normal[less].T, metal.sigma[less]
        solution.albedo[:, pixels], solution.specular[:, pixels] = 0, metal.specular[less].T
        solution.roughness[pixels] = metal.roughness[less]
        changed.append(pixels)
    found = np.concatenate(changed)
    if len(found):
        solution.blurred, solution.facts["blurred_metals"] = found, len(found)
    return found
