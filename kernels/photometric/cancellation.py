"""What the neighbours of a pixel say of light that is missing or added there.

Occlusion makes the response to a gradient longer, interreflection shorter. Where one goes over into the other both are present, and the
length is that of an open surface: such a pixel is as doubtful as those around it.
"""

import numpy as np

PART = 16
"""Neighbours are the pixels within one part in this many of the object's longer side: dents and grooves are wider."""
LEAST = 3
"""Least number of pixels of a 3 × 3 neighbourhood that are this doubtful: a groove one pixel wide has three, noise seldom."""


def neighbours_doubt(doubt: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the largest doubt in the neighbourhood of each pixel that LEAST pixels beside each other share.

    Args:
        doubt: [rows, cols] not negative, 0 outside the mask.
        inside: [rows, cols] bool, the mask.

    Returns:
        [rows, cols] float32, at least `doubt`; 0 outside the mask.
    """
    if not inside.any():
        return np.zeros(doubt.shape, np.float32)
    rows, cols = np.nonzero(inside)
    reach = max(1, (max(np.ptp(rows), np.ptp(cols)) + 1) // PART)
    padded = np.pad(doubt.astype(np.float32), 1)
    around = [padded[r : r + doubt.shape[0], c : c + doubt.shape[1]] for r in range(3) for c in range(3)]
    spread = np.partition(np.stack(around), -LEAST, axis=0)[-LEAST]
    for axis in (0, 1):
        spread = _largest(spread, reach, axis)
    return np.where(inside, np.maximum(spread, doubt), 0).astype(np.float32)


def _largest(values: np.ndarray, reach: int, axis: int) -> np.ndarray:
    """Return the largest value within `reach` along an axis, in doubling steps."""
    width = [(0, 0), (0, 0)]
    width[axis] = (reach, reach)
    window, result, length = 2 * reach + 1, np.moveaxis(np.pad(values, width), axis, 0), 1
    while length < window:
        step = min(length, window - length)
        result = np.maximum(result[:-step], result[step:])
        length += step
    return np.moveaxis(result, 0, axis)
