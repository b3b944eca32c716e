"""Points of tiles onto the grid of a board, and the blend of the patches of all tiles into one height map, by inverse variance."""

from typing import NamedTuple

import numpy as np

from service.boards.stitching.grid import BoardGrid, HeightMap, HeightPatch, gradients, shift_error
from service.boards.stitching.motions import Motions
from service.boards.stitching.overlap import UNKNOWNS

LEAST_WEIGHT = 0.5
"""The least sum of weights of the points around a measured pixel; where every pixel has a point, the sum is 1."""
LEAST_SHIFT_PX = 0.02
"""The least standard deviation of a tile's shift, pixels: what interpolation leaves of the shift that the overlaps measure."""
DISAGREE = 9.0
"""Tiles disagree at a pixel where chi squared over the degrees of freedom is more than this."""


def grid_points(x: np.ndarray, y: np.ndarray, z: np.ndarray, sigma: np.ndarray, grid: BoardGrid) -> HeightPatch:
    """Return the heights of scattered points on the smallest part of a grid that holds them.

    Each point counts in the four pixels around it by its bilinear weight, so that the weights of a point add up to one. The mean of a
    pixel is moved along the slope to the pixel's centre from where its points lie on average. The noise of a point is then spread over
    four pixels: `variance` is the weighted mean of σ², with which the sum of independent pixels has the variance that the sum over a
    region has, but for the region's border, where it is larger than the truth. `x`, `y`, `z`, `sigma`: [n] metres, board frame. Returns the
    patch, empty where no point lies on the grid."""
    row, col = grid.place(x, y)
    inside = (row > -1) & (row < grid.rows) & (col > -1) & (col < grid.cols)
    row, col, z, variance = row[inside], col[inside], z[inside].astype(np.float64), sigma[inside].astype(np.float64) ** 2
    if row.size == 0:
        empty = np.full((0, 0), np.nan)
        return HeightPatch(0, 0, empty, empty, 1.0)
    first_row, first_col = np.floor(row).astype(np.int64), np.floor(col).astype(np.int64)
    top, left = int(first_row.min()), int(first_col.min())
    rows, cols = int(first_row.max()) - top + 2, int(first_col.max()) - left + 2
    down, right = row - first_row, col - first_col
    base = (first_row - top) * cols + first_col - left
    mean = float(np.median(z))
    sums = np.zeros((6, rows * cols))
    for step_row in (0, 1):
        for step_col in (0, 1):
            weight = (down if step_row else 1 - down) * (right if step_col else 1 - right)
            at = base + step_row * cols + step_col
            for total, values in zip(sums, (weight, weight * (z - mean), weight * (down - step_row), weight * (right - step_col),
                                            weight * variance, weight * weight * variance), strict=True):
                total += np.bincount(at, values, minlength=rows * cols)
    weight, height, off_row, off_col, spread, own = sums.reshape(6, rows, cols)
    with np.errstate(divide="ignore", invalid="ignore"):
        usable = weight >= LEAST_WEIGHT
        height, off_row, off_col, spread, own = (np.where(usable, total / weight, np.nan)
                                                 for total in (height, off_row, off_col, spread, own))
        spread = spread / weight  # the more points a pixel has, the less noise
        own = own / weight
    across, along, _ = gradients(_filled(height))
    height = height - across * np.nan_to_num(off_col) - along * np.nan_to_num(off_row) + mean
    share = float(np.nanmedian(own / spread)) if usable.any() else 1.0
    kept_rows = slice(max(0, -top), min(rows, grid.rows - top))
    kept_cols = slice(max(0, -left), min(cols, grid.cols - left))
    return HeightPatch(max(top, 0), max(left, 0), height[kept_rows, kept_cols], spread[kept_rows, kept_cols], min(share, 1.0))


def _filled(height: np.ndarray) -> np.ndarray:
    """Return heights with missing ones from their neighbours: the mean of opposite ones, else of what two in a line extrapolate to."""
    padded = np.pad(height, 2, constant_values=np.nan)
    rows, cols = padded.shape

    def at(down: int, right: int) -> np.ndarray:
        return padded[2 + down : rows - 2 + down, 2 + right : cols - 2 + right]

    steps = ((0, 1), (1, 0), (0, -1), (-1, 0))
    between = [(at(*step) + at(-step[0], -step[1])) / 2 for step in steps[:2]]
    beyond = [2 * at(*step) - at(2 * step[0], 2 * step[1]) for step in steps]
    out = height
    for guesses in (between, beyond):
        known = [np.isfinite(guess) for guess in guesses]
        count = np.sum(known, axis=0)
        total = np.sum([np.where(there, guess, 0) for there, guess in zip(known, guesses, strict=True)], axis=0)
        out = np.where(np.isfinite(out) | (count == 0), out, total / np.maximum(count, 1))
    return out


class TileErrors(NamedTuple):
    """The errors that the pixels of a blend share, those of the tiles' shifts apart: shifts add up with the signs of the slopes, so that
    what stands whole on one tile moves, and neither grows nor shrinks."""

    grid: BoardGrid
    steady: np.ndarray  # [rows, cols] metres: as `systematic` of the height map, without the shifts
    shares: list[tuple[slice, slice, np.ndarray]]
    """Rows, columns and weight of each tile, [rows, cols] float32 of the patch, over the sum of all."""
    motions: Motions
    centre: tuple[float, float]
    length_m: float

    def shift_sigma(self, box: tuple[slice, slice], fill: tuple[np.ndarray, np.ndarray], values: np.ndarray, within: np.ndarray) -> float:
        """Return σ, by the shifts of all tiles, of the sum of values in a box of the grid.
        `fill`: rows and columns in the box, [rows, cols] each, of the measured pixel that stands for a pixel. `values`: [rows, cols].
        `within`: [rows, cols] bool, the pixels that are summed up."""
        down, across = (np.where(within, slope, 0) for slope in np.gradient(values))
        x, y = self.grid.coordinates(*np.mgrid[box])
        right, up = (x - self.centre[0]) / self.length_m, (y - self.centre[1]) / self.length_m
        change, least = np.zeros((len(self.shares), UNKNOWNS)), 0.0
        for number, (rows, cols, share) in enumerate(self.shares):
            if max(rows.start - box[0].stop, box[0].start - rows.stop, cols.start - box[1].stop, box[1].start - cols.stop) >= 0:
                continue
            own = np.zeros(values.shape)
            top, left = max(rows.start, box[0].start), max(cols.start, box[1].start)
            part = share[top - rows.start : box[0].stop - rows.start, left - cols.start : box[1].stop - cols.start]
            own[top - box[0].start :, left - box[1].start :][: part.shape[0], : part.shape[1]] = part
            along, upwards = own[fill] * across, -own[fill] * down
            change[number, :3] = along.sum(), upwards.sum(), (upwards * right - along * up).sum()
            least += LEAST_SHIFT_PX**2 * float(along.sum() ** 2 + upwards.sum() ** 2)
        there = np.flatnonzero(change)
        flat = change.ravel()[there] / self.grid.pixel_m
        return float(np.sqrt(max(flat @ self.motions.covariance[np.ix_(there, there)] @ flat, 0.0) + least))


class Blender:
    """Sums of patches over a grid."""

    def __init__(self, grid: BoardGrid, *, centre: tuple[float, float], length_m: float,
                 relief: np.ndarray | None = None) -> None:
        """Start with nothing; centre and length are those of the motions. `relief`: [rows, cols] heights whose slopes tell what a tile that
        is misplaced has wrong, metres, NaN where not known; None: those of each tile."""
        self.grid, self.centre, self.length_m, self.relief = grid, centre, length_m, relief
        shape = (grid.rows, grid.cols)
        self.weight, self.height, self.square, self.spread, self.systematic, self.steady = (np.zeros(shape) for _ in range(6))
        self.tiles = np.zeros(shape, dtype=np.uint8)
        self.parts: list[tuple[slice, slice, np.ndarray]] = []

    def add(self, patch: HeightPatch, covariance: np.ndarray, shared_m: float, *, noise_factor: float) -> None:
        """Add the patch of one tile.
        `covariance`: [6, 6] m² of the tile's motion, as in Motions. `shared_m`: standard deviation of the error that the pixels of a block
        share. `noise_factor`: the noise of the patch over what it says."""
        rows = slice(patch.row, patch.row + patch.height.shape[0])
        cols = slice(patch.col, patch.col + patch.height.shape[1])
        there = patch.measured
        if not there.any():
            self.parts.append((slice(0, 0), slice(0, 0), np.zeros((0, 0), np.float32)))
            return
        variance = np.where(there, patch.variance * noise_factor**2, 1.0)
        systematic, steady = self._systematic(patch, covariance, shared_m)
        weight = np.where(there, 1 / (variance + systematic**2), 0)
        height = np.where(there, patch.height, 0)
        self.weight[rows, cols] += weight
        self.height[rows, cols] += weight * height
        self.square[rows, cols] += weight * height**2
        self.spread[rows, cols] += weight**2 * variance
        self.systematic[rows, cols] += weight * systematic
        self.steady[rows, cols] += weight * steady
        self.parts.append((rows, cols, weight.astype(np.float32)))
        self.tiles[rows, cols] += there

    def result(self) -> HeightMap:
        """Return the height map."""
        height, variance, systematic, apart = self._means()
        return HeightMap(self.grid, height, variance, np.sqrt(systematic**2 + apart))

    def errors(self, motions: Motions) -> TileErrors:
        """Return the errors of the tiles, all of which have been added in the order of their motions."""
        total = np.maximum(self.weight, np.finfo(np.float32).tiny)
        shares = [(rows, cols, weight / total[rows, cols].astype(np.float32)) for rows, cols, weight in self.parts]
        steady = np.sqrt((self.steady / total) ** 2 + self._means()[3])
        return TileErrors(self.grid, steady, shares, motions, self.centre, self.length_m)

    def _means(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return height, variance and σ of shared errors, NaN where not measured, and the variance by which tiles disagree."""
        with np.errstate(divide="ignore", invalid="ignore"):
            there = self.weight > 0
            height = np.where(there, self.height / self.weight, np.nan)
            variance = np.where(there, self.spread / self.weight**2, np.nan)
            systematic = np.where(there, self.systematic / self.weight, np.nan)
            scatter = np.maximum(self.square - self.height**2 / self.weight, 0)  # chi squared of the tiles at each pixel
            apart = np.where((self.tiles > 1) & (scatter > DISAGREE * (self.tiles - 1.0)), scatter / self.weight, 0)
        return height, variance, systematic, apart

    def _systematic(self, patch: HeightPatch, covariance: np.ndarray, shared_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return σ in metres of the errors that neighbouring pixels of a tile share: its offset and tilt, its shift on slopes; and without
        the latter."""
        row, col = np.mgrid[patch.row : patch.row + patch.height.shape[0], patch.col : patch.col + patch.height.shape[1]]
        x, y = self.grid.coordinates(row, col)
        basis = np.stack([np.ones_like(x), (x - self.centre[0]) / self.length_m, (y - self.centre[1]) / self.length_m], axis=-1)
        plane = np.einsum("...i,ij,...j->...", basis, covariance[3:, 3:], basis)
        to_middle = np.array([[1, 0, -basis[..., 2].mean()], [0, 1, basis[..., 1].mean()]])
        shift = np.diag(to_middle @ covariance[:3, :3] @ to_middle.T) / self.grid.pixel_m**2 + LEAST_SHIFT_PX**2
        right, up = (float(value) for value in np.sqrt(shift))
        relief = patch.height if self.relief is None else self.relief[row, col]
        slopes = shift_error(np.where(np.isfinite(relief), relief, patch.height), (right, up), float(np.sqrt(np.nanmedian(patch.variance))))
        steady = np.maximum(plane, 0) + shared_m**2
        return np.sqrt(steady + slopes**2), np.sqrt(steady)
