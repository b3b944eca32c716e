"""Convert light of any direction to weights of the captured images by a table over a lat-long grid of directions.

Each pixel of the grid is shared out over the captured lights with the weights of `relit relight` without maps. These weights are
least-error ones that may not be negative, so those of a whole environment are close to the sum of those of its parts, and not equal.
"""

from typing import NamedTuple

import numpy as np

from kernels.relight.model.beyond import share_beyond
from service.relight.weights.weighting import light_weights, share_samples
from service.requests.relight import LightWeights
from stage.capture.point_lights import DistantLights

COLS, ROWS = 64, 32
"""Directions around and from +y to −y: 5.6 degrees apart, a third of the distance between the lights of a stage of a hundred."""
PARTS = 3
"""Samples down and across a pixel of the grid."""
FULL = 255
"""Stands for 1 in bytes."""


class Transfer(NamedTuple):
    """The weights of the captured images for a unit of irradiance from each direction of the grid, row by row."""

    weights: np.ndarray  # [ROWS · COLS, 3, lights] float32
    solid_angle: np.ndarray  # [ROWS · COLS] of the pixels, in any unit
    beyond: np.ndarray  # [ROWS, COLS] uint8: 0 between the captured lights, 255 wholly beyond them


def transfer_of(lights: DistantLights) -> Transfer:
    """Return the table of captured lights."""
    solid_angle = np.linalg.norm(grid_directions(PARTS, unit=False), axis=-1)
    energy = solid_angle / solid_angle.sum(axis=1, keepdims=True)
    share = share_beyond(lights.direction, grid_directions(1)[:, 0])
    return Transfer(weights_of(grid_directions(PARTS), energy, lights), solid_angle.sum(axis=1),
                    np.floor(FULL * share).astype(np.uint8).reshape(ROWS, COLS))


def weights_of(samples: np.ndarray, energy: np.ndarray, lights: DistantLights) -> np.ndarray:
    """Return the weights [kinds, 3, lights] float32 of the captured images for white light of several kinds.

    Args:
        samples: [kinds, n, 3] unit vectors to each.
        energy: [kinds, n] irradiance of each sample.
    """
    found = np.zeros((len(samples), 3, len(lights.direction)), dtype=np.float32)
    for begin in range(0, len(samples), COLS):
        part = slice(begin, begin + COLS)
        channels = np.stack([np.diag(each) for each in energy[part].T], axis=1)  # [kinds, n, kinds]: a channel of its own for each
        shared = share_samples(samples[part].reshape(-1, 3), channels.reshape(-1, channels.shape[2]), lights.direction,
                               weighting=LightWeights.KERNEL)
        found[part] = light_weights(shared.T[..., None].repeat(3, axis=2), lights.irradiance, np.ones(len(lights.direction)))
    return found


def grid_directions(parts: int, *, unit: bool = True) -> np.ndarray:
    """Return the directions of the grid, row by row, [ROWS · COLS, parts², 3] float64.

    Args:
        parts: samples down and across a pixel; 1: its middle.
        unit: make them unit vectors; else their length is sin πv, in proportion to the solid angle of a sample.

    Convention:
        +y at the top, +z in the middle of the grid, +x a quarter from the left edge.
    """
    v, u = ((np.arange(count * parts) + 0.5) / (count * parts) for count in (ROWS, COLS))
    polar, azimuth = np.pi * v[:, None], 2 * np.pi * u
    directions = np.stack(np.broadcast_arrays(np.sin(azimuth) * np.sin(polar), np.cos(polar), -np.cos(azimuth) * np.sin(polar)), axis=-1)
    if not unit:
        directions = directions * np.sin(polar)[..., None]
    return directions.reshape(ROWS, parts, COLS, parts, 3).swapaxes(1, 2).reshape(ROWS * COLS, parts**2, 3)
