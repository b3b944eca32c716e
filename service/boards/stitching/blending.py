"""Blending of the patches of all tiles into one height map, by inverse variance."""

from typing import NamedTuple

import numpy as np

from service.boards.stitching.grid import BoardGrid, HeightMap, HeightPatch, shift_error

LEAST_SHIFT_PX = 0.02
"""The least standard deviation of a tile's shift, pixels: what interpolation leaves of the shift that the overlaps measure."""
DISAGREE = 9.0
"""Tiles disagree at a pixel where chi squared over the degrees of freedom is more than this."""


class TileErrors(NamedTuple):
    """The errors of one tile's motion."""

    covariance: np.ndarray  # [6, 6] m², as in Motions
    shared_m: float
    """Standard deviation of the error that the pixels of a block share."""


class Blender:
    """Sums of patches over a grid."""

    def __init__(self, grid: BoardGrid, *, centre: tuple[float, float], length_m: float, noise_factor: float) -> None:
        """Start with nothing.

        Args:
            centre, length_m: of the motions.
            noise_factor: by which the noise of patches is larger than they say.
        """
        self.grid, self.centre, self.length_m, self.noise = grid, centre, length_m, noise_factor**2
        shape = (grid.rows, grid.cols)
        self.weight, self.height, self.square, self.spread, self.systematic = (np.zeros(shape) for _ in range(5))
        self.tiles = np.zeros(shape, dtype=np.uint8)

    def add(self, patch: HeightPatch, errors: TileErrors) -> None:
        """Add the patch of one tile."""
        rows = slice(patch.row, patch.row + patch.height.shape[0])
        cols = slice(patch.col, patch.col + patch.height.shape[1])
        there = patch.measured
        if not there.any():
            return
        variance = np.where(there, patch.variance * self.noise, 1.0)
        systematic = self._systematic(patch, errors)
        weight = np.where(there, 1 / (variance + systematic**2), 0)
        height = np.where(there, patch.height, 0)
        self.weight[rows, cols] += weight
        self.height[rows, cols] += weight * height
        self.square[rows, cols] += weight * height**2
        self.spread[rows, cols] += weight**2 * variance
        self.systematic[rows, cols] += weight * systematic
        self.tiles[rows, cols] += there

    def result(self) -> HeightMap:
        """Return the height map."""
        with np.errstate(divide="ignore", invalid="ignore"):
            there = self.weight > 0
            height = np.where(there, self.height / self.weight, np.nan)
            variance = np.where(there, self.spread / self.weight**2, np.nan)
            systematic = np.where(there, self.systematic / self.weight, np.nan)
            scatter = np.maximum(self.square - self.height**2 / self.weight, 0)  # chi squared of the tiles at each pixel
            apart = np.where((self.tiles > 1) & (scatter > DISAGREE * (self.tiles - 1.0)), scatter / self.weight, 0)
        return HeightMap(self.grid, height, variance, np.sqrt(systematic**2 + apart))

    def _systematic(self, patch: HeightPatch, errors: TileErrors) -> np.ndarray:
        """Return σ in metres of the errors that neighbouring pixels of a tile share: its offset and tilt, its shift on slopes."""
        row, col = np.mgrid[patch.row : patch.row + patch.height.shape[0], patch.col : patch.col + patch.height.shape[1]]
        x, y = self.grid.coordinates(row, col)
        basis = np.stack([np.ones_like(x), (x - self.centre[0]) / self.length_m, (y - self.centre[1]) / self.length_m], axis=-1)
        plane = np.einsum("...i,ij,...j->...", basis, errors.covariance[3:, 3:], basis)
        to_middle = np.array([[1, 0, -basis[..., 2].mean()], [0, 1, basis[..., 1].mean()]])
        shift = np.diag(to_middle @ errors.covariance[:3, :3] @ to_middle.T) / self.grid.pixel_m**2 + LEAST_SHIFT_PX**2
        right, up = (float(value) for value in np.sqrt(shift))
        slopes = shift_error(patch.height, (right, up), float(np.sqrt(np.nanmedian(patch.variance))))
        return np.asarray(np.sqrt(np.maximum(plane, 0) + errors.shared_m**2 + slopes**2))
