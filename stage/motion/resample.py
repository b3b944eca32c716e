"""Backward warping of images: interpolation at positions between pixels.

Positions are in array elements: (0, 0) is the centre of the first pixel.
"""

import cv2
import numpy as np


def positions(displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the position to which a displacement moves every pixel.
    `displacement`: [rows, cols, 2] float32, pixels right and down. Returns x and y, [rows, cols] float32, clamped to the image, and [rows,
    cols] bool, True where they lie inside the image."""
    rows, cols = displacement.shape[:2]
    x = displacement[..., 0] + np.arange(cols, dtype=np.float32)
    y = displacement[..., 1] + np.arange(rows, dtype=np.float32)[:, None]
    inside = (x >= 0) & (x <= cols - 1) & (y >= 0) & (y <= rows - 1)
    return np.clip(x, 0, cols - 1), np.clip(y, 0, rows - 1), inside


def lookup(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate an image bilinearly; OpenCV does so exactly in float from version 5 on, and rounded to 1/32 pixel before."""
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def bicubic(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate an image with the bicubic kernel of Catmull and Rom, which is exact on quadratic images.

    In one dimension the result is the linear interpolation of the image minus q times that of its second difference, with
    q = f(1 - f)/2 and f the fraction of the position. Two dimensions take four bilinear interpolations instead of sixteen gathered
    values in NumPy. OpenCV's cubic kernel, a = -0.75, is wrong by up to 0.05 pixels even on a ramp. `image`: [rows, cols] or [rows, cols,
    3] float32. `x`: [rows, cols] float32, within the image.

    Source:
        Keys, "Cubic convolution interpolation for digital image processing", IEEE Trans. ASSP 29(6), 1981, eq. 15 (a = -1/2).
    """
    second = np.array([[1, -2, 1]], dtype=np.float32)
    across = cv2.filter2D(image, -1, second, borderType=cv2.BORDER_REPLICATE)
    down = cv2.filter2D(image, -1, second.T, borderType=cv2.BORDER_REPLICATE)
    both = cv2.filter2D(across, -1, second.T, borderType=cv2.BORDER_REPLICATE)
    qx, qy = (0.5 * (part * (1 - part)).reshape(x.shape + (1,) * (image.ndim - 2)) for part in (x - np.floor(x), y - np.floor(y)))
    result = lookup(image, x, y) - qx * lookup(across, x, y) - qy * lookup(down, x, y) + qx * qy * lookup(both, x, y)
    return np.asarray(result)


def touched(flags: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return whether any of the sixteen pixels of a bicubic interpolation is flagged.
    `flags`: [rows, cols] bool. `x`: [rows, cols] float32, within the image. Returns [rows, cols] bool."""
    dilated = cv2.dilate(flags.astype(np.uint8), np.ones((4, 4), np.uint8), anchor=(1, 1))  # one pixel before to two after
    return np.asarray(dilated[y.astype(np.intp), x.astype(np.intp)] > 0)
