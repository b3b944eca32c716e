"""Find places where photometric normals and a fused surface contradict each other, so that normals must not move the surface.

Range images close the mouth of a narrow gap, and make a wall or a ramp of a step between two parts that stand one before the other. The
photographs show the normals of both parts there and no wall. A surface that was made to have these normals would be drawn from one part to
the other, and so would what lies beside. Averaged over one to four pixels the two differ there by far more than the noise of the depth and
the drift of normals.
"""

from typing import NamedTuple

import numpy as np

from service.scans.fusion.bands import Bands

LENGTHS_PX = (1.0, 2.0, 4.0)
"""Lengths over which normals are compared, pixels: a wall over a step is one or two pixels wide, and longer means have less noise."""
NOISE_PX = 32.0
"""Length over which the variance of the noise is averaged, pixels."""
SIGMAS = 3.0
"""Difference of normals that the noise of the depth explains, in its standard deviations."""
DRIFT = float(np.radians(10.0))
"""Difference, radians, that drift and chords of a bent surface explain: twice the error of lights that `relit join` allows for."""
MOTION_PX = 4.0
"""Length over which motions are compared with the noise, pixels: some 16 of them, so that the mean square of noise is 1 ± .35."""
MOTION = 2.0
"""Largest mean square of motions over that length, in variances of the depth, that noise explains."""


class Trust(NamedTuple):
    """The trust in the normals of the vertices."""

    agree: np.ndarray  # [V] bool, where the normals and the surface do not contradict each other
    counts: np.ndarray  # [V] 0…1, by how much each vertex counts where the drift of the normals is measured


def compared(bands: Bands, difference: np.ndarray, noise: np.ndarray, pixel_m: float) -> Trust:
    """Compare photometric normals with those of the surface, over several lengths.

    Args:
        difference: [V, 3] normals of the mesh without the photometric ones.
        noise: [V, 3] an example of the noise of the former.
        pixel_m: distance of neighbouring pixels on the surface.

    Source: the weights are those of Geman and McClure, "Statistical methods for tomographic image reconstruction", 1987.
    """
    means = [bands.averaged(np.concatenate([difference, noise], axis=1), length * pixel_m) for length in LENGTHS_PX]
    found, example = (np.stack([(mean[:, part] ** 2).sum(axis=1) for mean in means], axis=1) for part in (slice(3), slice(3, 6)))
    ratio = found / (SIGMAS**2 * bands.averaged(example, NOISE_PX * pixel_m) + DRIFT**2)
    return Trust(np.asarray((ratio <= 1).all(axis=1)), np.prod(1 / (1 + ratio) ** 2, axis=1))


def unlike_noise(bands: Bands, move: np.ndarray, sigma: np.ndarray, agree: np.ndarray, pixel_m: float) -> np.ndarray:
    """Return [V] bool, where the motions of the vertices around are larger than the noise of the depth explains.

    Args:
        move, sigma: [V] metres; sigma is the standard deviation of the depth.
        agree: [V] bool, the vertices that moved.
    """
    return np.asarray(agree & (bands.averaged((move / sigma)[:, None] ** 2, MOTION_PX * pixel_m, agree)[:, 0] > MOTION))
