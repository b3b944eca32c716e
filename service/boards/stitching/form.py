"""Forms of a board, planes, quadratic surfaces and splines, fitted to its deviations so that defects do not move them."""

import warnings
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.ndimage import map_coordinates

from service.boards.stitching.grid import BLOCK_PX, BoardGrid, blocks_of, robust_sigma
from stage.spread import tukey_weights

ROUNDS = 12
DEGREE = 3
"""The degree of the splines: they are cubic."""
SIGMA_PLACES = 33
"""Places along each side of a board at which the σ of a spline is computed; between them it is interpolated."""
BENDING = 1e-4
"""The weight of the bends of a spline against its blocks, so small that it decides only where there are none."""


class Form(NamedTuple):
    """A plane or a quadratic surface: coefficients of 1, x, y and, for the latter, x², x·y, y²; x and y run from -1 to 1 over a board."""

    coefficients: np.ndarray

    def over(self, grid: BoardGrid) -> np.ndarray:
        """Return its heights on a grid, [rows, cols] metres."""
        return np.asarray(np.tensordot(self.coefficients, _basis(*_unit(grid), count=len(self.coefficients)), axes=1))


class Spline(NamedTuple):
    """A bending surface: coefficients of products of cubic B-splines along y and x, [rows, cols], and how sure it is."""

    coefficients: np.ndarray
    spread: np.ndarray  # [rows · cols, rows · cols] m², the covariance of the coefficients

    def over(self, grid: BoardGrid) -> np.ndarray:
        """Return its heights on a grid, [rows, cols] metres."""
        x, y = _unit(grid)
        return np.asarray(_splines(y[:, 0], self.coefficients.shape[0]) @ self.coefficients @ _splines(x[0], self.coefficients.shape[1]).T)

    def sigma(self, grid: BoardGrid) -> np.ndarray:
        """Return its standard deviation on a grid, [rows, cols] metres, an error that all pixels within some knots share."""
        at = np.linspace(-1, 1, SIGMA_PLACES)
        down, across = (_splines(at, count) for count in self.coefficients.shape)
        basis = np.einsum("yr,xc->yxrc", down, across).reshape(SIGMA_PLACES**2, -1)
        coarse = np.sqrt(np.einsum("ni,ij,nj->n", basis, self.spread, basis)).reshape(SIGMA_PLACES, SIGMA_PLACES)
        x, y = _unit(grid)
        rows, cols = ((values.ravel() + 1) / 2 * (SIGMA_PLACES - 1) for values in (y, x))
        return np.asarray(map_coordinates(coarse, np.meshgrid(rows, cols, indexing="ij"), order=1))


def fit_form(grid: BoardGrid, height: np.ndarray, *, quadratic: bool) -> Form:
    """Fit a plane, or a quadratic surface with bow and twist, to the medians of blocks of heights by Tukey's weights, so that defects do
    not move it; heights are NaN where missing."""
    values, x, y = _middles(grid, height)
    return Form(_robust(_basis(x, y, count=6 if quadratic else 3), values)[0])


def fit_spline(grid: BoardGrid, height: np.ndarray, *, knots_m: float) -> Spline:
    """Fit a spline with knots at about a distance, as `fit_form` does a plane; where nothing is measured it bends as little as it can."""
    values, x, y = _middles(grid, height)
    down, across = (max(round(length / knots_m), 1) + DEGREE for length in reversed(grid.size_m))
    basis = np.einsum("nr,nc->rcn", _splines(y, down), _splines(x, across)).reshape(down * across, -1)
    bends = np.concatenate([np.kron(np.diff(np.eye(down), n=2, axis=0), np.eye(across)),
                            np.kron(np.eye(down), np.diff(np.eye(across), n=2, axis=0))])
    more = BENDING * len(values) / len(basis) * bends
    coefficients, scale = _robust(basis, values, more)
    return Spline(coefficients.reshape(down, across), scale**2 * np.linalg.pinv(basis @ basis.T + more.T @ more, hermitian=True))


def without_plane(values: np.ndarray, x: np.ndarray, y: np.ndarray, kept: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return values at places, all [n], less the plane that fits them best, or those `kept` of them."""
    basis = np.stack([np.ones(x.size), x, y], axis=1)
    return np.asarray(values - basis @ np.linalg.lstsq(basis[kept], values[kept], rcond=None)[0])


def _middles(grid: BoardGrid, height: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the medians of blocks of heights, and the middles x and y, from -1 to 1, of what is measured in them, all [blocks]."""
    side = max(1, min(BLOCK_PX, *(length // 6 for length in height.shape)))
    x, y = _unit(grid)
    blocks = blocks_of(height, side)
    count = np.isfinite(blocks).sum(axis=(2, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of blocks without any height, whose count is 0
        middle = np.nanmedian(blocks, axis=(2, 3))
    used = count >= max(1, side * side // 4)
    there = np.isfinite(blocks)
    px, py = (np.where(there, blocks_of(np.broadcast_to(values, height.shape), side), 0).sum(axis=(2, 3))[used] / count[used]
              for values in (x, y))
    return middle[used], px, py


def _robust(basis: np.ndarray, values: np.ndarray, further: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return the coefficients of a basis [count, n] that fit values [n] by Tukey's weights, and the spread of what is left; the products
    of `further` [m, count] with the coefficients are kept small."""
    weight, scale = np.ones_like(values), 0.0
    coefficients = np.zeros(len(basis))
    more = np.zeros((0, len(basis))) if further is None else further
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        rows, wanted = np.vstack([(basis * root).T, more]), np.concatenate([values * root, np.zeros(len(more))])
        coefficients = np.linalg.lstsq(rows, wanted, rcond=None)[0]
        left = values - coefficients @ basis
        scale = max(robust_sigma(left), 1e-12)
        weight = tukey_weights(left, scale)
    return coefficients, scale


def _splines(x: np.ndarray, count: int) -> np.ndarray:
    """Return the cubic B-splines, [n, count], with even knots from -1 to 1, at places [n]."""
    step = 2 / (count - DEGREE)
    knots = -1 + step * np.arange(-DEGREE, count + 1)
    return np.asarray(BSpline.design_matrix(np.clip(x, -1, 1 - 1e-12), knots, DEGREE).toarray())


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
