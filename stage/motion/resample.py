"""Backward warping: an image read at positions between its pixels.

Positions here are those of array elements, (0, 0) the centre of the first pixel.
"""

import cv2
import numpy as np


def positions(displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a displacement leads from every pixel.

    Args:
        displacement: [rows, cols, 2] float32, pixels right and down.

    Returns:
        x and y, [rows, cols] float32, brought to the nearest edge where they lie outside the image; and [rows, cols] bool,
        whether they lie inside.
    """
    rows, cols = displacement.shape[:2]
    x = displacement[..., 0] + np.arange(cols, dtype=np.float32)
    y = displacement[..., 1] + np.arange(rows, dtype=np.float32)[:, None]
    inside = (x >= 0) & (x <= cols - 1) & (y >= 0) & (y <= rows - 1)
    return np.clip(x, 0, cols - 1), np.clip(y, 0, rows - 1), inside


def lookup(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear reading; OpenCV's is exact in float from version 5 on, before that it rounded positions to 1/32 pixel."""
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def bicubic(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bicubic reading with the kernel of Catmull and Rom, the cubic one that is exact on quadratic images.

    In one dimension it is the linear reading of p less q times the linear reading of p's second difference, q = f(1 - f)/2 with f
    the fraction of the position: so in two dimensions four bilinear readings, and no gathering of sixteen values in NumPy.
    (OpenCV's own cubic kernel, a = -0.75, is not exact even on a ramp: it is off by up to 0.05 pixels.)

    Args:
        image: [rows, cols] or [rows, cols, 3] float32.
        x: [rows, cols] float32, within the image.
        y: the same.

    Returns:
        As the image.

    Source:
        Keys 1981, Cubic convolution interpolation for digital image processing, eq. 15 (a = -1/2).
    """
    second = np.array([[1, -2, 1]], dtype=np.float32)
    across = cv2.filter2D(image, -1, second, borderType=cv2.BORDER_REPLICATE)
    down = cv2.filter2D(image, -1, second.T, borderType=cv2.BORDER_REPLICATE)
    both = cv2.filter2D(across, -1, second.T, borderType=cv2.BORDER_REPLICATE)
    qx, qy = (0.5 * (part * (1 - part)).reshape(x.shape + (1,) * (image.ndim - 2)) for part in (x - np.floor(x), y - np.floor(y)))
    result = lookup(image, x, y) - qx * lookup(across, x, y) - qy * lookup(down, x, y) + qx * qy * lookup(both, x, y)
    return np.asarray(result)


def touched(flags: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether any of the sixteen pixels that a bicubic reading may take is flagged.

    Args:
        flags: [rows, cols] bool.
        x: [rows, cols] float32, within the image.
        y: the same.

    Returns:
        [rows, cols] bool.
    """
    near = cv2.dilate(flags.astype(np.uint8), np.ones((4, 4), np.uint8), anchor=(1, 1))  # one before to two behind
    return np.asarray(near[y.astype(np.intp), x.astype(np.intp)] > 0)
