"""The motions of all tiles at once, from what their overlaps say and from where the stage was told to be.

Every overlap gives the difference of two motions with its information matrix (`service.boards.stitching.overlap`); the stage gives a
position and a rotation for each tile with a standard deviation. Both are terms of one least-squares problem, in which a wrong shift, as on
pads of one pitch, loses its weight (Cauchy's weights on the shifts of overlaps) as soon as the loops of the other overlaps contradict it.
The offset and tilt of all tiles together are not determined, and are those of the smallest motions.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from service.boards.stitching.overlap import LATERAL, UNKNOWNS, Evidence, Overlap

ROUNDS = 30
FAR_PX = 1.0
"""Pixels from which on a measured shift contradicts the shifts of the other overlaps."""
HALF_WEIGHT_PX = 0.5
"""The contradiction, in pixels, at which a shift has half its weight."""
RANK = 1e-12
"""Eigenvalues below this part of the largest belong to what is not determined."""


class Motions(NamedTuple):
    """The motion of every tile: x, y, rotation · L, height, slopes · L, metres."""

    values: np.ndarray  # [tiles, 6]
    covariance: np.ndarray  # [6 tiles, 6 tiles] m², of the motions less their mean: where the whole board lies is no error of a tile
    contradicted: tuple[tuple[int, int], ...]
    """Overlaps whose shift the others contradict by FAR_PX or more; their offset and tilt count."""
    misfit_m: float
    """Root mean square of the heights by which overlaps differ still, at their middles."""

    def of_tile(self, tile: int) -> np.ndarray:
        """Return the covariance of one tile's motion, [6, 6]."""
        part = slice(UNKNOWNS * tile, UNKNOWNS * (tile + 1))
        return np.asarray(self.covariance[part, part])


def solve_motions(overlaps: Mapping[tuple[int, int], Overlap], middles: np.ndarray, *, length_m: float, pixel_m: float,
                  shift_sigma_m: float, turn_sigma: float) -> Motions:
    """Solve for the motion of every tile.

    Args:
        overlaps: by the tiles that they join; those whose evidence is DIFFERS are left out.
        middles: [tiles, 2] the middle of each tile relative to the centre about which motions turn, metres.
        length_m: L, metres.
        shift_sigma_m, turn_sigma: standard deviations of the stage's position along x and y, metres, and rotation, radians.
    """
    tiles = len(middles)
    used = {pair: overlap for pair, overlap in overlaps.items() if overlap.evidence is not Evidence.DIFFERS}
    prior = np.zeros((tiles * UNKNOWNS,) * 2)
    for tile, (x, y) in enumerate(middles / length_m):
        rows = np.array([[1, 0, -y, 0, 0, 0], [0, 1, x, 0, 0, 0], [0, 0, 1, 0, 0, 0]])
        part = slice(UNKNOWNS * tile, UNKNOWNS * (tile + 1))
        prior[part, part] = rows.T @ np.diag([1 / shift_sigma_m**2, 1 / shift_sigma_m**2, 1 / (turn_sigma * length_m) ** 2]) @ rows
    weights = dict.fromkeys(used, 1.0)
    values = np.zeros((tiles, UNKNOWNS))
    inverse = np.zeros_like(prior)
    for turn in range(ROUNDS):
        normal, right = prior.copy(), np.zeros(tiles * UNKNOWNS)
        for (i, j), overlap in used.items():
            information = _weighted(overlap.information, weights[i, j])
            a, b = slice(UNKNOWNS * i, UNKNOWNS * (i + 1)), slice(UNKNOWNS * j, UNKNOWNS * (j + 1))
            normal[a, a] += information
            normal[b, b] += information
            normal[a, b] -= information
            normal[b, a] -= information
            right[a] += information @ overlap.difference
            right[b] -= information @ overlap.difference
        inverse = _pseudo_inverse(normal)
        moved = (inverse @ right).reshape(tiles, UNKNOWNS)
        change = float(np.abs(moved - values).max())
        values = moved
        weights = {pair: 1 / (1 + (_apart(values, pair, overlap) / (HALF_WEIGHT_PX * pixel_m)) ** 2) for pair, overlap in used.items()}
        if turn and change < 1e-4 * pixel_m:
            break
    contradicted = tuple(pair for pair, overlap in used.items()
                         if overlap.evidence is Evidence.SHIFT and _apart(values, pair, overlap) > FAR_PX * pixel_m)
    heights = [_height_apart(values, pair, overlap) for pair, overlap in used.items()]
    relative = np.eye(tiles * UNKNOWNS) - np.tile(np.eye(UNKNOWNS) / tiles, (tiles, tiles))
    return Motions(values, relative @ inverse @ relative.T, contradicted, float(np.sqrt(np.mean(np.square(heights)))) if heights else 0.0)


def _weighted(information: np.ndarray, weight: float) -> np.ndarray:
    """Return an information matrix whose lateral unknowns count by a weight, and whose others keep what they say."""
    scale = np.ones(UNKNOWNS)
    scale[LATERAL] = np.sqrt(weight)
    return np.asarray(information * np.outer(scale, scale))


def _apart(values: np.ndarray, pair: tuple[int, int], overlap: Overlap) -> float:
    """Return by how many metres the shifts of two tiles differ from what their overlap says where it measures best; 0 if it says none."""
    information = overlap.information[:2, :2]
    if not information.any():
        return 0.0
    error = values[pair[0]] - values[pair[1]] - overlap.difference
    lateral = overlap.information[LATERAL, LATERAL]
    along = np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ lateral[:2] @ error[LATERAL]
    return float(np.hypot(*along))


def _height_apart(values: np.ndarray, pair: tuple[int, int], overlap: Overlap) -> float:
    """Return the height by which two tiles differ still at the middle of their overlap, metres."""
    error = values[pair[0]] - values[pair[1]] - overlap.difference
    information = overlap.information[3]
    return float(information[3:] @ error[3:] / information[3]) if information[3] > 0 else 0.0


def _pseudo_inverse(normal: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive matrix but for its null space."""
    values, vectors = np.linalg.eigh(normal)
    kept = values > RANK * values[-1]
    return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)
