"""Where the images of a capture without a mask show an object, and where a dark background."""

import numpy as np
from scipy import ndimage

OBJECT_PART, BRIGHTEST = 0.05, 0.999
"""Pixels that are brighter than this part of the brightest, which is this quantile, are of the object."""
RIM = 0.02
"""What is looked at around the object, as a part of the longer side: by the very outline, at which velvet is bright, 8 of 13 right
captures of it seemed to have turned lights."""


def lit_object(
    albedo: np.ndarray,  # [rows, cols], 0 where it is not known
) -> np.ndarray:
    """Return where an image shows the object and no dark background, whose noise hides what is wrong with lights, [rows, cols] bool:
    single pixels of noise are none, dark parts within it are of it, and so is RIM around it."""
    lit = ndimage.binary_fill_holes(ndimage.binary_opening(albedo > OBJECT_PART * np.quantile(albedo, BRIGHTEST)))
    return np.asarray(ndimage.binary_dilation(lit, iterations=max(1, round(RIM * max(lit.shape)))))
