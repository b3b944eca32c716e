"""Range images with fewer pixels: one depth for each square of pixels that shows one surface.

Along the lines of sight of a perspective camera the inverse depth of a plane is linear in the image, and that of a bent surface nearly
quadratic. The depth of a square is that at its centre of the quadratic function that fits its pixels: their mean would lie behind each
convex surface, by .2 mm on balls of 10 cm and squares of 15 mm. What the function leaves tells a square that shows two surfaces.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from service.scans.points.scan import Scan
from stage.capture.camera import Camera
from stage.colour.colour import convert

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


def coarser(scan: Scan, side: int) -> Scan:
    """Return a range image of a perspective camera whose pixels are squares of those of another, without normals; its maps stay."""
    assert scan.camera is not None
    found = squares_of(scan.image(-scan.points[:, 2]), scan.image(scan.depth_sigma()), scan.camera, side)
    there = found.depth > 0
    points = found.camera.points(-found.depth)[there]
    stretch = np.sqrt((points * points) @ np.ones(3, dtype=np.float32)) / found.depth[there]
    colours = confidence = None
    if scan.colours is not None:
        linear = convert(scan.image(scan.colours).astype(np.float32) / 255, "srgb_rec709_scene", "lin_rec709_scene")
        display = convert(np.ascontiguousarray(_cut(linear, side).mean(axis=(1, 3))), "lin_rec709_scene", "srgb_rec709_scene")[there]
        colours = np.rint(np.clip(display, 0, 1) * 255).astype(np.uint8)
    if scan.confidence is not None:
        confidence = _cut(scan.image(scan.confidence), side).mean(axis=(1, 3))[there]
    return replace(scan, points=points, sigma=(found.sigma[there] * stretch).astype(np.float32), normals=None,
                   colours=colours, confidence=confidence, camera=found.camera, pixels=np.flatnonzero(there))


def _cut(values: np.ndarray, side: int) -> np.ndarray:
    """Return an image [rows, cols, …] in whole squares: [rows, side, cols, side, …]."""
    rows, cols = values.shape[0] // side, values.shape[1] // side
    return values[:rows * side, :cols * side].reshape(rows, side, cols, side, *values.shape[2:])


def _means(depth: np.ndarray, sigma: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(values.mean(axis=(1, 3)))

    pixels = _cut(depth, side)
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
    noise = np.sqrt(mean(_cut(sigma, side) ** 2))
    good = whole & (left <= SIGMAS * noise * level**2 + BEND * np.hypot(*slopes)) & (level > 0)
    wider = np.sqrt(1 + 2 * apart**2 / bends) if side > 2 else 1.0
    level = np.where(good, level, 1)
    return np.where(good, 1 / level, 0), np.where(good, noise * wider / side, 0)
