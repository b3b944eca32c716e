"""The grid of a board, and height maps on it.

The board frame is the frame that the poses of the tiles lead to, as a rule that of the stage: x to the right, y up the image, z towards
the camera. Heights are z. A grid is an orthographic camera that looks along -z, so that its files carry it as `relit:camera`.
"""

from typing import NamedTuple, Self

import numpy as np
from scipy.ndimage import correlate1d, maximum_filter, uniform_filter

from stage.capture.camera import Camera
from stage.spread import MAD_TO_SIGMA

BLOCK_PX = 16
"""The side of the blocks, in pixels, in which errors that neighbouring pixels share are told from noise."""


class BoardGrid(NamedTuple):
    """Square pixels over a board."""

    pixel_m: float
    left_m: float
    """x of the left edge of the first column."""
    top_m: float
    """y of the upper edge of the first row."""
    rows: int
    cols: int

    @classmethod
    def of(cls, camera: Camera) -> Self:
        """Return the grid of a height map's orthographic camera.
        Raises ValueError if the camera is not orthographic, has no pixel_size_m, or its world_from_camera turns."""
        if camera.projection != "orthographic" or camera.pixel_size_m is None:
            raise ValueError("its camera must be orthographic with a pixel_size_m")
        x = y = 0.0
        if camera.world_from_camera is not None:
            pose = np.array(camera.world_from_camera)
            if not np.allclose(pose[:3, :3], np.eye(3), atol=1e-9):
                raise ValueError("its camera.world_from_camera must not turn: a height map looks along -z of the board frame")
            x, y = pose[:2, 3]
        cu, cv = camera.principal_point
        pixel = camera.pixel_size_m
        return cls(pixel, float(x - cu * pixel), float(y + cv * pixel), camera.height, camera.width)

    @classmethod
    def around(cls, low: np.ndarray, high: np.ndarray, pixel_m: float) -> Self:
        """Return the smallest grid from the corner `low` to the corner `high`, each [x, y] in metres."""
        cols, rows = np.maximum(np.ceil((high - low) / pixel_m).astype(int), 1)
        return cls(pixel_m, float(low[0]), float(high[1]), int(rows), int(cols))

    def camera(self) -> Camera:
        """Return the orthographic camera whose pixels are those of the grid."""
        return Camera(projection="orthographic", resolution=(self.cols, self.rows), pixel_size_m=self.pixel_m,
                      principal_px=(-self.left_m / self.pixel_m, self.top_m / self.pixel_m))

    def place(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return row and column, continuous and 0 at the first pixel's centre, of board-frame coordinates in metres."""
        return (self.top_m - y) / self.pixel_m - 0.5, (x - self.left_m) / self.pixel_m - 0.5

    def coordinates(self, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the board-frame x and y in metres of rows and columns: the inverse of `place`."""
        return self.left_m + (col + 0.5) * self.pixel_m, self.top_m - (row + 0.5) * self.pixel_m

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height in metres."""
        return self.cols * self.pixel_m, self.rows * self.pixel_m


class HeightPatch(NamedTuple):
    """Heights on a part of a grid, from its row `row` and column `col` on; NaN where nothing was measured."""

    row: int
    col: int
    height: np.ndarray  # [rows, cols] float64 metres, NaN where not measured
    variance: np.ndarray  # [rows, cols] float64 m²: of the noise, as a sum over pixels has it (`grid_points`)
    noise_share: float
    """Variance of the noise of one pixel over `variance`: less than one, because gridding spreads the noise of a point over pixels."""

    @property
    def measured(self) -> np.ndarray:
        """Return where there is a height, [rows, cols] bool."""
        return np.isfinite(self.height)


class HeightMap(NamedTuple):
    """Heights on a whole grid, or their deviations from those of another map, with both kinds of their errors."""

    grid: BoardGrid
    height: np.ndarray  # [rows, cols] float64 metres, NaN where not measured
    variance: np.ndarray  # [rows, cols] float64 m²: noise, independent from pixel to pixel in sums
    systematic: np.ndarray  # [rows, cols] float64 m: standard deviation of the errors that neighbouring pixels share

    @property
    def measured(self) -> np.ndarray:
        """Return where there is a height, [rows, cols] bool."""
        return np.isfinite(self.height)

    @property
    def sigma(self) -> np.ndarray:
        """Return the standard deviation of each pixel in metres, noise and shared errors together."""
        return np.sqrt(self.variance + self.systematic**2)

    def cut(self, where: tuple[slice, slice]) -> "HeightMap":
        """Return the heights of a part, which still names the whole grid."""
        return HeightMap(self.grid, self.height[where], self.variance[where], self.systematic[where])


def gradients(height: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the slopes of a height map, NaN where not measured, by Sobel's differences over 3 × 3 pixels.
    Returns slope along columns and along rows, per pixel and 0 where a neighbour is missing, and the factor by which each multiplies the
    standard deviation of independent noise (one number as an array of no dimension)."""
    padded = np.pad(height, 1, constant_values=np.nan)
    smooth = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    across = (smooth[:, 2:] - smooth[:, :-2]) / 8
    smooth = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    down = (smooth[2:] - smooth[:-2]) / 8
    usable = np.isfinite(across) & np.isfinite(down)
    return np.where(usable, across, 0), np.where(usable, down, 0), np.sqrt(np.float64(12 / 64))


def bends(height: np.ndarray) -> np.ndarray:
    """Return the larger second difference along rows and columns of a height map, smoothed (1 2 1) across, [rows, cols]; a missing
    neighbour counts as high as the pixel between, so that beside it the first difference is left. NaN where not measured."""
    padded = np.pad(height, 1, constant_values=np.nan)
    second = []
    for image in (padded, padded.T):
        middle = image[:, 1:-1]
        across = sum(np.where(np.isfinite(other), other - middle, 0) for other in (image[:, :-2], image[:, 2:]))
        known = np.isfinite(middle)
        total, weight = (correlate1d(values, [1.0, 2.0, 1.0], axis=0)[1:-1]
                         for values in (np.where(known, across, 0), known.astype(np.float64)))
        second.append(total / np.maximum(weight, 1))
    return np.where(np.isfinite(height), np.maximum(np.abs(second[0]), np.abs(second[1].T)), np.nan)


def edge_variance(bend: np.ndarray, noise: float) -> np.ndarray:
    """Return the variance of what interpolation makes wrong at edges, 0 where there is none, by the second differences of heights (`bends`)
    and the standard deviation of the noise of a pixel."""
    return np.where(bend > CLEAR_BEND * BEND_NOISE * noise, (BEND_SHARE * bend) ** 2, 0.0)


def shift_error(
    height: np.ndarray,  # [rows, cols], NaN where not measured
    sigma_px: tuple[float, float],  # standard deviation of the shift along columns and rows, pixels
    noise: float,  # standard deviation of the noise of a pixel
) -> np.ndarray:
    """Return σ of the error of heights that an uncertain shift makes, [rows, cols] in the unit of the heights.

    Slope times σ, where a slope is clear; of a shift that is uncertain by more than WIDE_PX, half of what heights differ by within 2.5 σ
    of a pixel, less what noise alone differs by. Both are taken from the heights and from their means over SMOOTHED pixels too, whose
    slopes are clear where noise hides those of single pixels.
    """
    error = np.zeros(height.shape)
    for side in (1, *SMOOTHED):
        means, left = height, noise / side
        if side > 1:
            means = local_means(height, side)
            means = np.where(np.abs(means - height) < FLAT * noise, means, np.nan)
        across, down, gain = gradients(means)
        clear = np.hypot(across, down) > CLEAR_SLOPE * float(gain) * left
        error = np.maximum(error, np.where(clear, np.hypot(sigma_px[0] * across, sigma_px[1] * down), 0.0))
        if max(sigma_px) > WIDE_PX:
            size = tuple(2 * int(np.ceil(2.5 * sigma)) + 1 for sigma in reversed(sigma_px))
            high, low = (maximum_filter(np.where(np.isfinite(means), sign * means, -np.inf), size, mode="constant", cval=-np.inf)
                         for sign in (1, -1))
            error = np.maximum(error, np.clip(high + low - NOISE_SPAN * left, 0, None) / 2)
    return error


def local_means(height: np.ndarray, side: int) -> np.ndarray:
    """Return the means of what was measured in the square of a side about each pixel, NaN where the pixel was not, [rows, cols]."""
    known = np.isfinite(height)
    total, count = (uniform_filter(values, side, mode="constant") for values in (np.where(known, height, 0), known.astype(np.float64)))
    return np.where(known, total / np.where(known, count, 1), np.nan)


SMOOTHED = (3, 9)
"""Sides of the squares, pixels, whose means tell slopes that the noise of pixels hides."""
FLAT = 4.0
"""Means count where they are within so many σ of the noise of their pixel: they do not smear walls, which are clear without them."""
WIDE_PX = 0.4
"""A shift that is more uncertain than this is beyond what the slope at a pixel tells."""
CLEAR_SLOPE = 4.0
"""A slope counts where it is this many times its noise."""
NOISE_SPAN = 8.0
"""The range of noise within a window of some hundred pixels, in σ."""
BEND_SHARE = 1 / 3
"""The error that interpolation makes at an edge, as a part of the second difference there: a step of height h between two pixels is seen
anywhere from 0 to h, with a standard deviation of h / √12; 1/3 is a little more."""
CLEAR_BEND = 4.0
"""A second difference counts where it is this many times its noise."""
BEND_NOISE = float(np.sqrt(6 * 6 / 16))
"""The factor by which `bends` multiplies the standard deviation of independent noise along either direction."""


def robust_sigma(values: np.ndarray) -> float:
    """Return 1.4826 times the median absolute deviation from the median, which is σ of a normal distribution; 0 of no values."""
    if values.size == 0:
        return 0.0
    return float(MAD_TO_SIGMA * np.median(np.abs(values - np.median(values))))


def blocks_of(values: np.ndarray, side: int = BLOCK_PX) -> np.ndarray:
    """Return a view of an image in square blocks, [down, across, side, side]; what is left at the right and below is cut off."""
    rows, cols = (length // side * side for length in values.shape)
    return values[:rows, :cols].reshape(rows // side, side, cols // side, side).swapaxes(1, 2)
