"""Breaks of a depth map: which neighbouring pixels show one surface, and which show two, one behind the other.

A surface may be seen at any angle: towards the horizon the depth of a floor changes by a large part of itself from one row to the next.
Along the lines of sight of a perspective camera the inverse depth of a plane is linear in the image, up to the horizon. Two neighbours
therefore show one surface where the slope between them is at most 80°, where their difference is within the noise of the depth, or where
the inverse depths of the pixels on one side lie on a line that leads to the other pixel. A pixel that mixes two surfaces lies on no such
line, so that blurred edges stay breaks.
"""

import numpy as np

from stage.capture.camera import Camera

STEEPEST = 5.67
"""The tangent of 80°: where depth changes faster between two neighbouring pixels, only further evidence says that they show one surface."""
SIDE = 4
"""The number of pixels on one side that must lie on a line: more than an edge makes that is blurred over two pixels."""
SIGMAS = 3.0
"""The largest departure from a line, or difference between neighbours, that noise explains, in its standard deviations."""
BEND = 0.25
"""The largest departure from a line that the bend of a surface explains, as a part of the line's slope from pixel to pixel."""
LINEAR = 0.1
"""The largest standard deviation that counts, as a part of the depth: with a larger one that of the inverse depth has no meaning, and
pixels close to the camera would be joined to everything behind them."""
BATCH = 1 << 17
"""The number of steep steps that are looked at together, which bounds the memory (some 60 MB)."""

_POSITION = np.arange(SIDE) - (SIDE - 1) / 2
"""The positions of the pixels on a line, from their middle."""
_SLOPE = _POSITION / np.sum(_POSITION**2)
"""The weights of the values on a line in the slope of the least-squares line through them."""
_NEXT = 1 / SIDE + (SIDE + 1) / 2 * _SLOPE
"""The weights of the values on a line in that line one pixel further."""

_PREDICTED = float(np.sqrt(1 + np.sum(_NEXT**2)))
"""The standard deviation of a pixel's departure from the line of the pixels before it, in that of one pixel."""


def same_surface(first: np.ndarray, second: np.ndarray, distance_px: float | np.ndarray, camera: Camera) -> np.ndarray:
    """Return whether the slope between two depths is at most 80 degrees.
    `first`, `second`: depths in metres, of one shape; their order does not matter. `distance_px`: the distance between their two pixels, in
    pixels. Returns bool in the shape of the depths."""
    if camera.focal_px is None:
        return np.asarray(np.abs(first - second) <= STEEPEST * (camera.pixel_size_m or 1.0) * distance_px)
    footprint = np.minimum(first, second) / min(camera.focal_px)
    return np.asarray(np.abs(first - second) <= STEEPEST * footprint * distance_px)


def connected(depth: np.ndarray, mask: np.ndarray, camera: Camera, offset: tuple[int, int], *,
              sigma: np.ndarray | None = None) -> np.ndarray:
    """Return for each pixel whether its neighbour at an offset shows the same surface.
    Returns [rows, cols] bool; False where either pixel lies outside the mask or the image.

    Args:
        depth: [rows, cols] metres, above zero in the mask.
        mask: [rows, cols] bool, True where there is a depth.
        offset: rows downwards, at least 0, and columns to the right, which may be negative.
        sigma: [rows, cols] metres, standard deviation of the depth; values that are not finite count as 0. None: 0 everywhere.
    """
    (down, right), (rows, cols) = offset, depth.shape
    first_col, last_col = max(-right, 0), max(cols - max(right, 0), 0)
    here = slice(0, max(rows - down, 0)), slice(first_col, last_col)
    there = slice(down, rows), slice(first_col + right, last_col + right)
    joined = np.zeros(depth.shape, dtype=bool)
    if first_col >= last_col:
        return joined
    both = mask[here] & mask[there]
    gentle = same_surface(depth[here], depth[there], float(np.hypot(down, right)), camera)
    joined[here] = both & gentle
    pixels = np.argwhere(both & ~gentle) + np.array((0, first_col))
    for start in range(0, len(pixels), BATCH):
        batch = pixels[start:start + BATCH]
        joined[tuple(batch.T)] = _continues(*_along(depth, sigma, mask, camera, batch, offset))
    return joined


def _along(depth: np.ndarray, sigma: np.ndarray | None, mask: np.ndarray, camera: Camera, pixels: np.ndarray, offset: tuple[int, int]
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what is linear on planes (inverse depth, or depth under an orthographic camera), its standard deviation and its presence.
    Returns [2 SIDE, n] each: SIDE pixels up to each of `pixels` [n, 2], and SIDE from its neighbour on."""
    places = np.arange(1 - SIDE, SIDE + 1)[:, None]
    row, col = (pixels[:, axis] + places * offset[axis] for axis in (0, 1))
    inside = (row >= 0) & (row < mask.shape[0]) & (col >= 0) & (col < mask.shape[1])
    index = np.where(inside, row, 0), np.where(inside, col, 0)
    present = inside & mask[index]
    value = np.where(present, depth[index], 1).astype(np.float64)
    noise = np.zeros(value.shape) if sigma is None else sigma[index].astype(np.float64)
    noise = np.where(present & np.isfinite(noise), noise, 0)
    if camera.focal_px is None:
        return value, noise, present
    return 1 / value, np.minimum(noise / value, LINEAR) / value, present


def _continues(value: np.ndarray, sigma: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return [n] bool: True where noise explains the difference across the middle, or the line of one side leads to the other."""
    before, after = slice(0, SIDE), slice(None, SIDE - 1, -1)  # both towards the middle
    around = np.nanmedian(np.where(present, sigma, np.nan), axis=0)  # pixels that mix two surfaces are less sure than those around them
    least = np.minimum(np.minimum(sigma[SIDE], sigma[SIDE - 1]), around)
    found = np.abs(value[SIDE] - value[SIDE - 1]) <= SIGMAS * np.sqrt(2) * least
    for side, target in ((before, SIDE), (after, SIDE - 1)):
        slope = _SLOPE @ value[side]
        noise, bend = SIGMAS * np.minimum(np.median(sigma[side], axis=0), around), BEND * np.abs(slope)
        off_line = np.abs(value[side] - value[side].mean(axis=0) - np.outer(_POSITION, slope))
        straight = (present[side] & (off_line <= noise + bend)).all(axis=0)
        found |= straight & (np.abs(value[target] - _NEXT @ value[side]) <= noise * _PREDICTED + bend)
    return found
