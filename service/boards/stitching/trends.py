"""What the motions of all tiles have in common and no overlap contradicts: distances that are too long, and tilts that grow with the place.

Tiles that are all bent alike fit together if each is tilted in proportion to its place; that bends the board by the square of the number of
tiles more than one of them is bent. Tiles that are all too large fit together if they are moved apart.
"""

import numpy as np
from scipy.stats import t as student

from service.boards.stitching.motions import Motions
from service.boards.stitching.overlap import UNKNOWNS

CHANCE = 1e-4
"""Probability of a sentence about tiles whose errors have no trend."""
LEAST_FREEDOM = 3
"""Numbers beyond those of the trend that the scatter about it is measured from."""
LEAST_BEND, LEAST_STRETCH = 3.0, 1.0
"""Bend of the board over σ of a height, and displacement of its border in pixels, below which neither matters."""


def trend_sentences(middles: np.ndarray, motions: Motions, measured: np.ndarray, *, length_m: float, tile_m: float, pixel_m: float,
                    sigma_m: float) -> list[str]:
    """Return a sentence for tilts, and one for shifts, that grow with the place of the tiles.

    Args:
        middles: [tiles, 2] the middle of each tile relative to the centre about which motions turn, metres.
        measured: [tiles] bool, tiles whose shift an overlap tells.
        length_m: L of the motions, half of the larger side of the board. `tile_m`: half of that of a tile. `sigma_m`: of a height.
    """
    found = []
    count, (x, y) = len(middles), middles.T
    zero, one = np.zeros(count), np.ones(count)
    place = np.eye(count * UNKNOWNS).reshape(count, UNKNOWNS, -1)  # [tiles, unknowns] rows that take an unknown of a tile
    bends, sure = _trend([[one, zero, x, y, zero], [zero, one, zero, x, y]], np.stack([place[:, 4], place[:, 5]]) / length_m, motions)
    wide, high = np.abs(middles).max(axis=0) + tile_m
    bend_m = sure[2:] * np.abs(bends[2:]) * (wide**2 / 2, wide * high, high**2 / 2)
    if bend_m.max() > LEAST_BEND * sigma_m:
        tile_bend_m = abs(bends[2 + bend_m.argmax()]) * tile_m**2 / 2
        found.append(f"tiles tilt the more the farther they lie from the middle, which bends the board by {bend_m.max():.2g} m: bow and "
                     f"twist are right only if each tile was levelled before; else each tile is bent by {tile_bend_m:.2g} m, by the "
                     "calibration of its camera, or the stage sags; σ does not hold it")
    x, y, count = x[measured], y[measured], int(measured.sum())
    zero, one, place = np.zeros(count), np.ones(count), place[measured]
    shifts = np.stack([place[:, 0] - y[:, None] / length_m * place[:, 2], place[:, 1] + x[:, None] / length_m * place[:, 2]])
    stretch, sure = _trend([[one, zero, -y, x], [zero, one, x, y]], shifts, motions)
    if sure[3] and abs(stretch[3]) * length_m > LEAST_STRETCH * pixel_m:
        found.append(f"tiles lie {1 + stretch[3]:.4f} times as far apart as their positions say: check pixel_size_m or the calibration of "
                     "the camera, and the scale of the stage; the board is as much too large or too small if it is the camera")
    return found


def _trend(basis: list[list[np.ndarray]], rows: np.ndarray, motions: Motions) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients of a basis [2][count][tiles] that fit two combinations of unknowns [2, tiles, unknowns of all], by least
    squares, and which of them neither the scatter of the tiles nor their covariance explains, [count] bool."""
    terms, taken = np.concatenate([np.stack(part, axis=1) for part in basis]), rows.reshape(-1, rows.shape[-1])
    inverse, values = np.linalg.pinv(terms), taken @ motions.values.reshape(-1)
    coefficients = inverse @ values
    freedom = len(values) - np.linalg.matrix_rank(terms)
    if freedom < LEAST_FREEDOM:
        return coefficients, np.zeros(len(coefficients), dtype=bool)
    scatter = np.square(values - terms @ coefficients).sum() / freedom
    sigma = np.sqrt(np.diag(inverse @ (taken @ motions.covariance @ taken.T + scatter * np.eye(len(values))) @ inverse.T))
    return coefficients, np.abs(coefficients) > student.isf(CHANCE / 2, freedom) * sigma
