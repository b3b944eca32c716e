"""Measure the neighbourhood of each pixel: the mean, the contrast of a texture, and how far a bent surface lies from a plane."""

import numpy as np

WINDOW_REACH = 4
"""Half side of the window in which a disparity is fitted as a plane."""
MEAN_SQUARE = WINDOW_REACH * (WINDOW_REACH + 1) / 3
"""Mean square of the distance of the window's columns from its middle."""
MOST_BEND_PX = 1.5
"""Second differences beyond are steps of depth."""
LEAST_KNOWN = 0.3
"""Least part of the neighbours whose second difference must be known."""


def box_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the mean in a square of 2 reach + 1 pixels around each pixel, [rows, cols] float64; borders are continued."""
    size = 2 * reach + 1
    for axis in (0, 1):
        padded = np.pad(values.astype(np.float64), [(reach + 1, reach) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        total = np.moveaxis(np.cumsum(padded, axis=axis), axis, 0)
        values = np.moveaxis((total[size:] - total[:-size]) / size, 0, axis)
    return values


def contrast(images: np.ndarray, reach: int) -> np.ndarray:
    """Return the standard deviation of the readings in a square around each pixel, root mean square over the frames: [rows, cols] float32.

    Args:
        images: [frames, rows, cols] float32.
        reach: half side of the square.
    """
    total = np.zeros(images.shape[1:])
    for image in images:
        readings = image.astype(np.float64) - float(image.mean())
        total += np.maximum(box_mean(readings**2, reach) - box_mean(readings, reach) ** 2, 0)
    return np.sqrt(total / len(images)).astype(np.float32)


def bend(disparity: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Return by how much a plane that is fitted in the window of each pixel lies above a surface that bends, in pixels of disparity.

    A surface of curvature k lies k x² / 2 above its tangent at a distance x, and the plane of least squares k/2 times the mean of x² above
    it in the middle. The curvature is the second difference over the window, averaged over the pixels around.

    Args:
        disparity: [rows, cols] float32, each fitted as a plane.
        usable: [rows, cols] bool, where it holds.

    Returns:
        [rows, cols] float64; 0 where too few neighbours hold.
    """
    total = np.zeros(disparity.shape)
    for axis in (0, 1):
        before, after = (np.roll(disparity, shift, axis) for shift in (WINDOW_REACH, -WINDOW_REACH))
        known = usable & np.roll(usable, WINDOW_REACH, axis) & np.roll(usable, -WINDOW_REACH, axis)
        along = np.moveaxis(known, axis, 0)
        along[:WINDOW_REACH] = along[-WINDOW_REACH:] = False  # np.roll comes round from the other side
        second = before.astype(np.float64) + after - 2.0 * disparity
        known &= np.abs(second) < MOST_BEND_PX
        share = box_mean(known, WINDOW_REACH)
        mean = box_mean(np.where(known, second, 0), WINDOW_REACH) / np.maximum(share, 1e-9)
        total += np.where(share > LEAST_KNOWN, mean, 0) / WINDOW_REACH**2
    return total / 2 * MEAN_SQUARE
