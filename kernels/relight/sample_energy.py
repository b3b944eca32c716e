"""The energy of a few far samples of light, shared out over the captured lights as whole environments are.

The samples lie in NumPy: a few hundred directions are too few for a launch.
"""

import numpy as np

from kernels.relight.environment import Weighting
from kernels.relight.kernel_quadrature import share_kernel
from kernels.relight.latlong import first_of_equals
from kernels.relight.smooth import share_smooth


def share_samples(samples: np.ndarray, energy: np.ndarray, directions: np.ndarray, *, weighting: Weighting) -> np.ndarray:
    """Share the energy of samples out over the captured lights.

    Args:
        samples: [n, 3] unit vectors to the samples.
        energy: [n, channels] of each.
        directions: [lights, 3] unit vectors to the lights; of several in one place the first gets all.
        weighting: how.

    Returns:
        [lights, channels] float64; its sum is that of the samples.

    Raises:
        ArrayError: for smooth weighting, fewer than four lights in different places, or all of them in one plane.
    """
    if weighting is Weighting.KERNEL:
        return share_kernel(samples, energy, directions)
    kept = first_of_equals(directions)
    given = np.zeros((len(directions), energy.shape[1]))
    if weighting is Weighting.SMOOTH:
        given[kept] = share_smooth(samples, energy, directions[kept])
        return given
    nearest = (samples @ directions[kept].T).argmax(axis=1)
    for channel, amount in enumerate(energy.T):
        given[kept, channel] = np.bincount(nearest, weights=amount, minlength=len(kept))
    return given
