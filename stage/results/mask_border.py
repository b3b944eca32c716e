"""The border of a mask: distances to it, the pixels along it, and its outline between the pixels."""

import math
from collections.abc import Callable

import cv2
import numpy as np

SHARP_PX = 1.5
"""The reach where only the pixels that the outline crosses are partly covered."""
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=np.uint8)
RIDGE = 0.75
"""The middle of a part that is thinner than twice the reach is wholly covered if it lies this share of the reach inside."""
SMOOTH_PX = 1.2
"""The standard deviation of the Gaussian filter that finds the outline of a mask between its pixels: the one with the least error of those
tried on masks of ellipses, which a wider filter rounds and a narrower one leaves in steps."""
WINDOW_PX = 2.5
"""The standard deviation of the window in which two outlines are compared."""
NORMAL_X = np.linspace(-3.5, 3.5, 701)
NORMAL_CDF = np.array([0.5 * (1 + math.erf(x / math.sqrt(2))) for x in NORMAL_X])
"""The cumulative distribution of the normal distribution at NORMAL_X."""


def distance(mask: np.ndarray) -> np.ndarray:
    """Return [rows, cols] float32 the distance of each pixel to the nearest pixel of a mask, 0 on it."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5))


def nearest(mask: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from places [n, 2], row and column, to the nearest pixels [n, 2] of a mask that is not empty."""
    _, label = cv2.distanceTransformWithLabels((~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    at = np.zeros(int(label.max()) + 1, dtype=np.int64)
    pixels = np.flatnonzero(mask)
    at[label.reshape(-1)[pixels]] = pixels
    return lambda places: np.stack(np.divmod(at[label[places[:, 0], places[:, 1]]], mask.shape[1]), axis=-1)


def rim(mask: np.ndarray) -> np.ndarray:
    """Return the pixels of a mask beside which is one outside."""
    return mask & ~_eroded(mask)


def inside(mask: np.ndarray, reach: float) -> np.ndarray:
    """Return the pixels of a mask that the object covers wholly: all but those within reach of its border, and the middle of thin parts."""
    if reach == SHARP_PX:
        return _eroded(mask)
    depth = distance(~mask)
    ridge = (depth >= RIDGE * reach) & (depth >= cv2.dilate(depth, np.ones((5, 5), np.uint8)))
    return mask & ((depth > reach) | ridge)


def border(mask: np.ndarray, whole: np.ndarray, reach: float) -> np.ndarray:
    """Return the pixels of a mask that are not whole, and those outside within reach of it."""
    return (mask & ~whole) | (~mask & (distance(mask) <= reach))


def outline_coverage(mask: np.ndarray, *, shift_px: float, blur_px: float) -> np.ndarray:
    """Return the coverage [rows, cols] float32 that follows from the smoothed outline of a mask.
    `mask`: the pixels that are covered by more than a half. `shift_px`: how far the object reaches beyond the mask; negative where the mask
    is wider. `blur_px`: the standard deviation of the images' filter."""
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), SMOOTH_PX, borderType=cv2.BORDER_REPLICATE)
    depth = SMOOTH_PX * np.interp(smooth, NORMAL_CDF, NORMAL_X)  # from the outline, which the filter of a straight edge gives
    return np.interp((depth + shift_px) / blur_px, NORMAL_X, NORMAL_CDF).astype(np.float32)


def outline_offset(difference: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return [rows, cols] how far one outline lies beyond another, in pixels, as a mean over a window.
    `difference`: [rows, cols] of the coverage of the two. `along`: [rows, cols] bool, the rim of one of them."""
    area, length = (cv2.GaussianBlur(values.astype(np.float32), (0, 0), WINDOW_PX) for values in (difference, along))
    return area / np.maximum(length, 1e-6)


def _eroded(mask: np.ndarray) -> np.ndarray:
    return cv2.erode(mask.astype(np.uint8), CROSS, borderValue=1).astype(bool)
