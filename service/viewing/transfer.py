"""From light of any direction to the coefficients of a basis: a table over a lat-long grid of directions.

Each pixel of the grid is shared out over the captured lights with the weights of `relit relight` without maps. These weights are
least-error ones that may not be negative, so those of a whole environment are close to the sum of those of its parts, and not equal.
"""

from typing import NamedTuple

import numpy as np

from kernels.relight.basis import Basis
from kernels.relight.beyond import share_beyond
from kernels.relight.environment import Weighting, light_weights
from kernels.relight.sample_energy import share_samples
from stage.point_lights import DistantLights

COLS, ROWS = 64, 32
"""Directions around and from +y to −y: 5.6 degrees apart, a third of the distance between the lights of a stage of a hundred."""
PARTS = 3
"""Samples down and across a pixel of the grid."""
FULL = 255
"""Stands for 1 in bytes."""


class Transfer(NamedTuple):
    """The coefficients of a unit of irradiance from each direction of the grid."""

    coefficients: np.ndarray  # [ROWS, COLS, terms, 3] float32
    beyond: np.ndarray  # [ROWS, COLS] uint8: 0 between the captured lights, 255 wholly beyond them


def transfer_of(basis: Basis, lights: DistantLights, scale: float) -> Transfer:
    """Return the table of a basis.

    Args:
        basis: of the captured images.
        lights: of the images.
        scale: value of a stored 1.0 of the coefficient images.

    Raises:
        ArrayError: a light gives nothing in a channel.
    """
    weights = np.stack([light_weights(energy[None], lights.irradiance, np.ones(len(lights.direction)))[0]
                        for energy in _shares(lights.direction)])  # [directions, 3, lights]
    found = np.einsum("ckl,dcl->dkc", basis.matrix * scale, weights)
    share = share_beyond(lights.direction, grid_directions(1)[:, 0])
    return Transfer(found.reshape(ROWS, COLS, *found.shape[1:]).astype(np.float32),
                    np.floor(FULL * share).astype(np.uint8).reshape(ROWS, COLS))


def _shares(direction: np.ndarray) -> np.ndarray:
    """Return [directions, lights, 3] the energy that each light gets of one unit from each direction of the grid."""
    given = np.zeros((ROWS * COLS, len(direction), 3))
    solid_angle = np.linalg.norm(grid_directions(PARTS, unit=False), axis=-1)
    for index, samples in enumerate(grid_directions(PARTS)):
        energy = solid_angle[index, :, None] / solid_angle[index].sum()
        given[index] = share_samples(samples, energy, direction, weighting=Weighting.KERNEL)
    return given


def grid_directions(parts: int, *, unit: bool = True) -> np.ndarray:
    """Return the directions of the grid, row by row.

    Args:
        parts: samples down and across a pixel; 1: its middle.
        unit: make them unit vectors; else their length is sin πv, in proportion to the solid angle of a sample.

    Returns:
        [ROWS · COLS, parts², 3] float64.

    Convention:
        +y at the top, +z in the middle of the grid, +x a quarter from the left edge.
    """
    v, u = ((np.arange(count * parts) + 0.5) / (count * parts) for count in (ROWS, COLS))
    polar, azimuth = np.pi * v[:, None], 2 * np.pi * u
    directions = np.stack(np.broadcast_arrays(np.sin(azimuth) * np.sin(polar), np.cos(polar), -np.cos(azimuth) * np.sin(polar)), axis=-1)
    if not unit:
        directions = directions * np.sin(polar)[..., None]
    return directions.reshape(ROWS, parts, COLS, parts, 3).swapaxes(1, 2).reshape(ROWS * COLS, parts**2, 3)
