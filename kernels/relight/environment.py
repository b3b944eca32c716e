"""A lat-long environment → per-light RGB weights.

The environment is shared out over the lights, by one of three weightings; the weight of a light of irradiance E is the energy that it
was given divided by E.

Source: Debevec et al., SIGGRAPH 2000, section 3.3.
"""

from enum import Enum, auto

import numpy as np

from kernels.errors import ArrayError
from kernels.relight.cells import integrate_cells
from kernels.relight.kernel_quadrature import integrate_kernel
from kernels.relight.smooth import integrate_smooth


class Weighting(Enum):
    """Ways to share the environment out over the lights."""

    KERNEL = auto()
    """As `integrate_kernel` does: the least expected error of the frame; a moving sun fades from light to light."""
    CELLS = auto()
    """As `integrate_cells` does: shadows and highlights are as sharp as a light's own, and a moving sun steps from light to light."""
    SMOOTH = auto()
    """As `integrate_smooth` does: a moving sun fades from light to light, and shadows of three lights show at once."""


def integrate(environment: np.ndarray, directions: np.ndarray, rotations: np.ndarray, *, weighting: Weighting,
              device: str) -> np.ndarray:
    """Share a lat-long map out over the lights, for several rotations of the map.

    Args:
        environment: [rows, cols, 3] scene-linear radiance; top row +y, image centre +z, a quarter from the left +x.
        directions: [lights, 3] unit vectors from the object to the lights (without padding).
        rotations: [frames, 3, 3]: the environment is turned by these, turned = rotation @ direction.
        weighting: how.
        device: where nearest lights or triangles are found; sums are taken on the host in float64.

    Returns:
        [frames, lights, 3] float64 energy of each light; it sums to that of the whole map.

    Raises:
        ArrayError: shapes that do not fit, directions that are not unit vectors, radiance that is negative or not finite (counted);
            for smooth weighting also fewer than four lights in different places, or all of them in one plane.
    """
    if weighting is Weighting.KERNEL:
        return integrate_kernel(environment, directions, rotations)
    chosen = {Weighting.CELLS: integrate_cells, Weighting.SMOOTH: integrate_smooth}[weighting]
    return chosen(environment, directions, rotations, device=device).energy


def light_weights(energy: np.ndarray, irradiance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the weight of each stored image with which their sum is lit by the environment.

    Args:
        energy: [frames, lights, 3] of each light, of integrate.
        irradiance: [lights, 3] of each captured light, without padding.
        scale: [lights padded] radiance of a stored 1.0.

    Returns:
        [frames, 3, lights padded] float32.

    Raises:
        ArrayError: a light gives nothing in a channel, so that its part of the energy there could not be placed.
    """
    dark = np.argwhere(irradiance <= 0)
    if len(dark):
        light, channel = dark[0]
        raise ArrayError(f"irradiance of light {light} is 0 in channel {'RGB'[channel]}: "
                         "its part of the environment would stay dark in it")
    frames, lights, _ = energy.shape
    weights = np.zeros((frames, 3, len(scale)), dtype=np.float32)
    weights[:, :, :lights] = np.swapaxes(energy / irradiance, 1, 2) * scale[:lights]
    return weights
