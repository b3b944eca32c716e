"""The picture of a comparison: the scan from two sides in the colours of its deviations, and their histogram."""

from pathlib import Path

import numpy as np

from service.boards.inspection_picture import HIGH, LOW, MIDDLE, OUTSIDE
from service.comparison.deviations import Deviations
from service.relight.sheet import write_sheet

PICTURE_FILE = "comparison.png"
SIDE_PX = 480
BINS = 100
FULL_COLOUR = 99.0
"""The percentile of the sizes of the deviations that has the full colour."""
LEFT_OUT = np.array([0.35, 0.35, 0.37])
"""The colour of points that do not belong to the design."""
VIEWS = {"front": np.array([0.5, 0.35, 0.8]), "back": np.array([-0.5, -0.35, -0.8])}
"""Directions towards the viewer, in the frame of the design."""
LIT = 0.45
"""Share of the colour that surfaces keep where they turn away from the viewer."""


def span_of(found: Deviations) -> float:
    """Return the deviation that has the full colour, metres."""
    return max(float(np.percentile(np.abs(found.distance), FULL_COLOUR)), 1e-12)


def colours_of(found: Deviations, span_m: float) -> np.ndarray:
    """Return the colour of each point of the scan, [n, 3] from 0 to 1: blue inside of the design, red outside, grey far from it."""
    part = np.clip(found.distance / span_m, -1, 1)[:, None]
    colours = np.tile(LEFT_OUT, (len(found.placed), 1))
    colours[found.near] = MIDDLE + np.where(part < 0, LOW - MIDDLE, HIGH - MIDDLE) * np.abs(part)
    return colours


def write_picture(path: Path, found: Deviations, colours: np.ndarray, span_m: float, spacing_m: float) -> None:
    """Write two views and the histogram as one PNG.

    Args:
        colours: [n, 3] of `colours_of`, whose full colour is at `span_m`.
        spacing_m: the distance of neighbouring points.
    """
    views = [(f"from the {name}, {-1e3 * span_m:.3g} to {1e3 * span_m:.3g} mm", _view(found, colours, toward, spacing_m))
             for name, toward in VIEWS.items()]
    write_sheet(path, [[*views, ("deviations, share of the points", _histogram(found, span_m))]], height=SIDE_PX)


def _view(found: Deviations, colours: np.ndarray, toward: np.ndarray, spacing_m: float) -> np.ndarray:
    toward = toward / np.linalg.norm(toward)
    right = np.cross([0.0, 1.0, 0.0], toward)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(toward, right), toward])
    points = found.placed @ frame.T
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    scale = (SIDE_PX - 20) / max(float((high - low).max()), 1e-12)
    col, row = np.rint((points[:, :2] - (low + high) / 2) * scale * [1, -1] + SIDE_PX / 2).astype(int).T
    facing = found.normals @ toward
    order = np.argsort(points[:, 2])
    order = order[facing[order] > 0]
    shown = colours[order] * (LIT + (1 - LIT) * facing[order])[:, None]
    image = np.tile(OUTSIDE, (SIDE_PX, SIDE_PX, 1))
    half = int(np.clip(np.ceil(0.6 * spacing_m * scale), 1, 8))
    for down in range(-half, half + 1):
        for along in range(-half, half + 1):
            if down * down + along * along <= half * half:  # the nearest comes last at each offset, and the middle last of all
                image[(row[order] + down).clip(0, SIDE_PX - 1), (col[order] + along).clip(0, SIDE_PX - 1)] = shown
    image[row[order], col[order]] = shown
    return image.astype(np.float32)


def _histogram(found: Deviations, span_m: float) -> np.ndarray:
    count, edges = np.histogram(np.clip(found.distance, -span_m, span_m), bins=BINS, range=(-span_m, span_m))
    height = np.rint(count / max(count.max(), 1) * (SIDE_PX - 20)).astype(int)
    image = np.tile(OUTSIDE, (SIDE_PX, SIDE_PX, 1))
    wide = SIDE_PX // BINS
    for number, (tall, middle) in enumerate(zip(height, (edges[1:] + edges[:-1]) / 2, strict=True)):
        part = abs(middle) / span_m
        colour = MIDDLE + ((LOW if middle < 0 else HIGH) - MIDDLE) * part
        image[SIDE_PX - 10 - tall:SIDE_PX - 10, number * wide + (SIDE_PX - BINS * wide) // 2:][:, :wide] = colour
    return image.astype(np.float32)
