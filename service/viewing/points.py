"""The points of a depth: places, colours, depth and confidence of every so many pixels."""

from typing import Any

import numpy as np

from service.viewing.block_file import BlockFile
from service.viewing.reduction import step_within
from service.viewing.result_layers import ResultLayers
from stage.colour.colour import convert
from stage.formats.ply import POINTS_FILE, read_ply

MOST_POINTS = 1_000_000
"""Most points of a view; of more, every second, third … pixel is taken in both directions."""
WHITE_PERCENTILE = 99.0
"""Percentile of the amplitude that is shown as white where there are no colours."""
DEPTH_TOLERANCE = 1e-5
"""Largest relative difference of a depth and that of a point of points.ply which is taken for the same pixel: float32 rounding."""


def write_points(found: ResultLayers, file: BlockFile) -> dict[str, Any]:
    """Write the points of a depth, first those of the mask and then the unsure ones, and return what view.json says of them."""
    step = step_within(int(found.estimated.sum()), MOST_POINTS)
    pixels, unsure = (_every(mask, step) for mask in (found.mask, found.estimated & ~found.mask))
    chosen = np.concatenate([pixels, unsure])
    depth = found.plane("depth").reshape(-1)[chosen].astype(np.float32)
    confidence = found.plane("confidence").reshape(-1)[chosen] if "confidence" in found.names() else np.ones(len(chosen), dtype=np.float32)
    colours = _colours(found, chosen)
    return {
        "count": len(pixels), "unsure": len(unsure), "step": step,
        "positions": file.append(found.camera.points_at(chosen, -depth)),
        "colours": None if colours is None else file.append(colours),
        "depth": file.append(depth),
        "confidence": file.append(np.rint(255 * np.clip(confidence.astype(np.float32), 0, 1)).astype(np.uint8)),
    }


def _every(mask: np.ndarray, step: int) -> np.ndarray:
    """Return the row-major positions of the pixels of a mask at every step-th row and column."""
    kept = np.zeros_like(mask)
    kept[::step, ::step] = mask[::step, ::step]
    return np.flatnonzero(kept)


def _colours(found: ResultLayers, pixels: np.ndarray) -> np.ndarray | None:
    """Return [n, 3] uint8 sRGB: of points.ply for the pixels that it has, else grey of the amplitude; None without either."""
    colours = None
    if "amplitude" in found.names():
        amplitude = found.plane("amplitude").astype(np.float32)
        inside = amplitude[found.mask]
        white = float(np.percentile(inside, WHITE_PERCENTILE)) if inside.size else 0.0
        grey = np.clip(amplitude.reshape(-1)[pixels] / (white or 1.0), 0, 1)
        encoded = convert(np.ascontiguousarray(np.repeat(grey[None, :, None], 3, axis=2)), "lin_rec709_scene", "srgb_texture")
        colours = np.rint(255 * np.clip(encoded[0], 0, 1)).astype(np.uint8)
    beside = found.path.parent / POINTS_FILE
    cloud = read_ply(beside) if beside.is_file() else None
    solved = found.mask.reshape(-1)
    if cloud is None or len(cloud.points) != solved.sum():  # points between pixels
        return colours
    depth = found.plane("depth").reshape(-1)[solved]
    if not np.allclose(-cloud.points[:, 2], depth, rtol=DEPTH_TOLERANCE):
        return colours
    if colours is None:
        colours = np.full((len(pixels), 3), 128, dtype=np.uint8)
    number = np.cumsum(solved) - 1
    own = solved[pixels]
    colours[own] = cloud.colours[number[pixels[own]]]
    return colours
