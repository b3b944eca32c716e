"""Make normals less sure where the surface bends within what a pixel sees.

A pixel reads the mean of the light from a spot as wide as the pixel and the lens make it. Where normals change evenly over that spot, its
mean is that of the middle; at a crease, a rim or a relief of a few pixels it is not, and the readings of a mixture of two normals look
like those of a third. A spot of variance b² in every direction shifts a smooth function by b²/2 of its Laplacian: that is the error of a
normal, as far as differences of neighbours show more than their noise.

Source: the mean over a spot by Taylor's series, as in diffusion (Koenderink, "The structure of images", Biological Cybernetics 1984).
"""

import numpy as np

from kernels.photometric.search.certainty import MOST

SPOT = 0.5
"""Standard deviation, in pixels, of the spot that a pixel sees: of its square 0.29, of a sharp lens about 0.4. On path-traced scenes
without a lens 0.3 to 0.6 serve nearly alike."""
BAND_PIXELS = 1 << 20
"""Number of pixels that are looked at in one piece: it bounds the memory."""


def unseen_bend(normal: np.ndarray, sigma: np.ndarray, solved: np.ndarray) -> np.ndarray:
    """Return the error of normals by what pixels see beside their middle, [rows, cols] float32 degrees. In quadrature with `sigma` it makes
    no normal less sure than one of which hardly anything is known.

    Args:
        normal: [3, rows, cols] unit normals.
        sigma: [rows, cols] their standard deviation in degrees; what noise of that size makes of differences is taken off.
        solved: [rows, cols] bool, where they hold. Along rows and columns only pixels between two of these tell anything.
    """
    found, step = np.zeros(solved.shape, np.float32), max(1, BAND_PIXELS // solved.shape[1])
    for first in range(0, len(solved), step):
        above = max(first - 1, 0)
        band = slice(above, first + step + 1)
        found[first : first + step] = _bend_of_rows(normal[:, band], sigma[band], solved[band])[first - above :][:step]
    return found


def _bend_of_rows(normal: np.ndarray, sigma: np.ndarray, solved: np.ndarray) -> np.ndarray:
    variance = np.square(np.radians(sigma.astype(np.float32)))
    laplacian, noise, weight = np.zeros_like(normal, dtype=np.float32), np.zeros_like(variance), np.zeros_like(variance)
    for axis in (0, 1):
        before, middle, after = (tuple(slice(at, at + size - 2) if along == axis else slice(None)
                                       for along, size in enumerate(solved.shape)) for at in range(3))
        told = solved[before] & solved[middle] & solved[after]
        laplacian[:, *middle] += np.where(told, normal[:, *before] + normal[:, *after] - 2 * normal[:, *middle], 0)
        noise[middle] += np.where(told, variance[before] + variance[after], 0)
        weight[middle] += 2 * told
    noise += weight**2 * variance
    bend = np.degrees(SPOT**2 / 2 * np.sqrt(np.maximum(np.square(laplacian).sum(axis=0) - noise, 0)))
    return np.minimum(bend, np.degrees(np.sqrt(np.maximum(np.radians(MOST) ** 2 - variance, 0))))
