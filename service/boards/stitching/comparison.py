"""The deviation of a measured height map from the nominal one, with its noise and with the errors that neighbouring pixels share."""

import warnings
from typing import NamedTuple

import numpy as np

from service.boards.stitching.grid import BEND_NOISE, BLOCK_PX, BoardGrid, HeightMap, bends, blocks_of, robust_sigma, shift_error
from service.boards.stitching.overlap import TUKEY

BEND_SHARE = 1 / 3
"""The error that interpolation makes at an edge, as a part of the second difference there: a step of height h between two pixels is seen
anywhere from 0 to h, with a standard deviation of h / √12; 1/3 is a little more."""
CLEAR_BEND = 4.0
"""A second difference counts where it is this many times its noise."""
MATCH_PX = 0.05
"""The least standard deviation of the shift between two maps, pixels: optics and sampling differ from map to map."""
ROUNDS = 12


class Form(NamedTuple):
    """A plane or a quadratic surface: coefficients of 1, x, y and, for the latter, x², x·y, y²; x and y run from -1 to 1 over a board."""

    coefficients: np.ndarray

    def over(self, grid: BoardGrid) -> np.ndarray:
        """Return its heights on a grid, [rows, cols] metres."""
        return np.asarray(np.tensordot(self.coefficients, _basis(*_unit(grid), count=len(self.coefficients)), axes=1))


def compare(measured: HeightMap, nominal: HeightMap, *, shift_sigma_m: tuple[float, float]) -> HeightMap:
    """Return the deviation of two height maps on one grid.

    To the shared errors of both maps come those of edges, where a shift and interpolation change heights: slope times the uncertainty
    of the shift between the maps, and a part of the second difference.

    Args:
        shift_sigma_m: standard deviation along x and y of the registration of the measured map.
    """
    deviation = measured.height - nominal.height
    known = np.isfinite(deviation)
    variance = measured.variance + nominal.variance
    noise = float(np.sqrt(np.median(variance[known]))) if known.any() else 0.0
    offset = float(np.median(deviation[known])) if known.any() else 0.0
    whole = np.where(np.isfinite(nominal.height), nominal.height, measured.height - offset)
    seen = np.where(np.isfinite(measured.height), measured.height - offset, whole)
    bend = np.maximum(*(np.where(np.isfinite(found := bends(heights)), found, 0) for heights in (whole, seen)))
    right, up = (max(sigma / measured.grid.pixel_m, MATCH_PX) for sigma in shift_sigma_m)
    edges = np.where(bend > CLEAR_BEND * BEND_NOISE * noise, BEND_SHARE * bend, 0) ** 2
    edges += shift_error((whole + seen) / 2, (right, up), noise) ** 2
    systematic = np.sqrt(measured.systematic**2 + nominal.systematic**2 + edges)
    return HeightMap(measured.grid, deviation, variance, np.where(known, systematic, np.nan))


def fit_form(grid: BoardGrid, height: np.ndarray, *, quadratic: bool) -> Form:
    """Fit a plane, or a quadratic surface with bow and twist, to the medians of blocks of heights by Tukey's weights, so that defects do
    not move it; heights are NaN where missing."""
    side = max(1, min(BLOCK_PX, *(length // 6 for length in height.shape)))
    x, y = _unit(grid)
    blocks = blocks_of(height, side)
    count = np.isfinite(blocks).sum(axis=(2, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of blocks without any height, whose count is 0
        middle = np.nanmedian(blocks, axis=(2, 3))
    used = count >= max(1, side * side // 4)
    places = [blocks_of(np.broadcast_to(values, height.shape), side).mean(axis=(2, 3))[used] for values in (x, y)]
    values, basis = middle[used], _basis(places[0], places[1], count=6 if quadratic else 3)
    weight = np.ones_like(values)
    coefficients = np.zeros(len(basis))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq((basis * root).T, values * root, rcond=None)[0]
        left = values - coefficients @ basis
        scale = max(robust_sigma(left), 1e-12)
        weight = np.square(np.clip(1 - np.square(left / (TUKEY * scale)), 0, None))
    return Form(coefficients)


def bow_and_twist(form: Form, grid: BoardGrid) -> float:
    """Return the largest distance of a quadratic form from the plane nearest to it, metres."""
    height = form.over(grid)
    x, y = _unit(grid)
    plane = _basis(np.broadcast_to(x, height.shape).ravel(), np.broadcast_to(y, height.shape).ravel(), count=3)
    return float(np.abs(height.ravel() - np.linalg.lstsq(plane.T, height.ravel(), rcond=None)[0] @ plane).max())


def _unit(grid: BoardGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return x [1, cols] and y [rows, 1] of pixel centres from -1 to 1."""
    return ((np.arange(grid.cols) + 0.5) / grid.cols * 2 - 1)[None], (1 - (np.arange(grid.rows) + 0.5) / grid.rows * 2)[:, None]


def _basis(x: np.ndarray, y: np.ndarray, *, count: int) -> np.ndarray:
    """Return the first terms of a quadratic surface, [count, …]."""
    one = np.ones(np.broadcast_shapes(x.shape, y.shape))
    return np.stack([one, x * one, y * one, x * x * one, x * y * one, y * y * one][:count])
