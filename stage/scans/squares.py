"""Range images with fewer pixels: one depth for each square of pixels that shows one surface.

Along the lines of sight of a perspective camera the inverse depth of a plane is linear in the image, and that of a bent surface nearly
quadratic. The depth of a square is that at its centre of the quadratic function that fits its pixels: their mean would lie behind each
convex surface, by .2 mm on balls of 10 cm and squares of 15 mm. What the function leaves tells a square that shows two surfaces.
"""

from typing import NamedTuple

import numpy as np

from stage.camera import Camera

SIGMAS = 3.0
"""The largest RMS departure from a plane that noise explains, in its standard deviations."""
BEND = 0.25
"""The largest such departure that the bend of a surface explains, as a part of the change of the inverse depth from pixel to pixel."""
ROWS = 512
"""About how many rows of pixels are looked at at one time, which bounds the memory."""


class CoarseImage(NamedTuple):
    """A range image of squares of pixels."""

    camera: Camera
    depth: np.ndarray  # [rows, cols] float32 metres; 0 where the square has none
    sigma: np.ndarray  # [rows, cols] float32 metres, standard deviation of the depth


def squares_of(depth: np.ndarray, sigma: np.ndarray, camera: Camera, side: int) -> CoarseImage:
    """Return the range image whose pixels are squares of those of another.

    Args:
        depth: [rows, cols] metres; 0 where there is none.
        sigma: [rows, cols] metres, standard deviation of the depth; the errors of pixels are independent.
        camera: a perspective camera.
        side: of a square, pixels; of two, the depth is the mean.

    Returns:
        An image without a depth where a pixel of the square has none, or where they show two surfaces. What does not fill a square at the
        right and at the lower border of the image is left out.
    """
    assert camera.focal_px is not None
    rows, cols = camera.height // side, camera.width // side
    u, v = camera.principal_point
    coarse = camera.model_copy(update={"resolution": (cols, rows), "focal_px": (camera.focal_px[0] / side, camera.focal_px[1] / side),
                                       "principal_px": (u / side, v / side)})
    found, spread = np.zeros((rows, cols), dtype=np.float32), np.zeros((rows, cols), dtype=np.float32)
    step = max(1, ROWS // side)
    for first in range(0, rows, step):
        part = slice(first * side, min(first + step, rows) * side), slice(0, cols * side)
        found[first:first + step], spread[first:first + step] = _means(depth[part], sigma[part], side)
    return CoarseImage(coarse, found, spread)


def _means(depth: np.ndarray, sigma: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth and its standard deviation of the squares of some rows."""
    def cut(values: np.ndarray) -> np.ndarray:
        return values.reshape(values.shape[0] // side, side, values.shape[1] // side, side)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(values.mean(axis=(1, 3)))

    pixels = cut(depth)
    whole = (pixels > 0).all(axis=(1, 3))
    inverse = 1 / np.where(pixels > 0, pixels, np.float32(1))
    corner = inverse[:, :1, :, :1]
    off = inverse - corner  # short numbers, whose squares single precision can hold
    across = np.arange(side, dtype=np.float32) - np.float32((side - 1) / 2)
    down = across[:, None, None]
    apart, fourth = float((across**2).mean()), float((across**4).mean())
    bends = fourth - apart**2  # the variance of the squares; 0 of two pixels, which show no bend
    middle = mean(off)
    slopes = [mean(off * way) / apart for way in (across, down)]
    bent = [mean(off * (way**2 - np.float32(apart))) / bends if side > 2 else np.zeros_like(middle) for way in (across, down)]
    twist = mean(off * (across * down)) / apart**2
    fitted = sum(slope**2 * apart for slope in slopes) + sum(each**2 * bends for each in bent) + twist**2 * apart**2
    left = np.sqrt(np.maximum(mean((off - middle[:, None, :, None]) ** 2) - fitted, 0))
    level = middle - sum(each * apart for each in bent) + corner[:, 0, :, 0]
    noise = np.sqrt(mean(cut(sigma) ** 2))
    good = whole & (left <= SIGMAS * noise * level**2 + BEND * np.hypot(*slopes)) & (level > 0)
    wider = np.sqrt(1 + 2 * apart**2 / bends) if side > 2 else 1.0
    level = np.where(good, level, 1)
    return np.where(good, 1 / level, 0), np.where(good, noise * wider / side, 0)
