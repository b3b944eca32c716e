"""The picture of an inspection: height, deviation and verdict, side by side."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.boards.findings import Defect
from service.boards.stitching.grid import BoardGrid, HeightMap
from service.boards.stitching.regions import Verdict
from service.relight.sheet import fit, write_sheet

PICTURE_FILE = "inspection.png"
TILE_PX = 480
"""Height of each panel."""
LOW, MIDDLE, HIGH = np.array([0.13, 0.35, 0.85]), np.array([0.93, 0.93, 0.93]), np.array([0.85, 0.16, 0.12])
PASSED, FAILED, OPEN = np.array([0.20, 0.42, 0.28]), np.array([0.95, 0.20, 0.15]), np.array([0.95, 0.75, 0.15])
"""Colours of what passed, failed, and was not inspected or not decided."""
OUTSIDE = np.array([0.055, 0.058, 0.065])
SPAN_SIGMA = 6.0
"""The least deviation, in median σ, that has the full colour."""


class Frame(NamedTuple):
    """A rectangle of the board with a verdict."""

    centre_m: tuple[float, float]
    size_m: tuple[float, float]
    verdict: Verdict | None
    """None: nothing was judged."""


def write_picture(path: Path, heights: HeightMap, deviation: HeightMap | None, inspected: np.ndarray | None, wanted: np.ndarray | None,
                  defects: Sequence[Defect], frames: Sequence[Frame]) -> None:
    """Write the panels as one PNG.
    `deviation`, `inspected`, `wanted`: of the comparison, [rows, cols]: the pixels that were inspected, and those that have a nominal
    height. `defects` and `frames` are drawn as frames."""
    low, high = np.percentile(heights.height[heights.measured], [1, 99])
    grey = np.clip((heights.height - low) / max(high - low, 1e-12), 0, 1)
    shown = np.where(heights.measured[..., None], grey[..., None] * np.ones(3), OUTSIDE)
    panels = [(f"height, {1e6 * low:.4g} to {1e6 * high:.4g} µm", shown)]
    if deviation is not None and inspected is not None and wanted is not None:
        span = max([abs(defect.peak_m) for defect in defects] + [SPAN_SIGMA * float(np.median(deviation.sigma[deviation.measured]))])
        panels.append((f"deviation, {-1e6 * span:.3g} to {1e6 * span:.3g} µm", _signed(deviation.height / span, deviation.measured)))
        failed = len(defects) + sum(frame.verdict is Verdict.FAIL for frame in frames)
        panels.append((f"{failed} fail; yellow: not inspected or undecided", _verdicts(deviation.grid, inspected, wanted, defects, frames)))
    write_sheet(path, [[(title, _reduced(np.nan_to_num(image).astype(np.float32))) for title, image in panels]], height=TILE_PX)


def _reduced(image: np.ndarray) -> np.ndarray:
    """Return an image at the height of the panels; a smaller one with its pixels repeated."""
    times = max(1, TILE_PX // image.shape[0])
    return fit(np.repeat(np.repeat(image, times, axis=0), times, axis=1), TILE_PX, kernel="triangle")


def _signed(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    part = np.clip(np.nan_to_num(values), -1, 1)[..., None]
    return np.where(known[..., None], np.where(part < 0, MIDDLE + (LOW - MIDDLE) * -part, MIDDLE + (HIGH - MIDDLE) * part), OUTSIDE)


def _verdicts(grid: BoardGrid, inspected: np.ndarray, wanted: np.ndarray, defects: Sequence[Defect],
              frames: Sequence[Frame]) -> np.ndarray:
    image = np.where(wanted[..., None], np.where(inspected[..., None], PASSED, OPEN), OUTSIDE)
    for frame in frames:
        colour = {Verdict.FAIL: FAILED, Verdict.PASS: MIDDLE, None: MIDDLE}.get(frame.verdict, OPEN)
        _frame(image, grid, frame.centre_m, frame.size_m, colour)
    for defect in defects:
        area = defect.area
        grown = area.width_m + 6 * grid.pixel_m, area.height_m + 6 * grid.pixel_m
        _frame(image, grid, (area.x_m, area.y_m), grown, FAILED)
    return np.asarray(image)


def _frame(image: np.ndarray, grid: BoardGrid, centre: tuple[float, float], size: tuple[float, float], colour: np.ndarray) -> None:
    """Draw a rectangle into an image, as thick as one pixel of the panel."""
    x, y = (np.array([-0.5, 0.5]) * length + middle for length, middle in zip(size, centre, strict=True))
    row, col = grid.place(x, y[::-1])
    top, bottom = (int(np.clip(round(float(value)), 0, grid.rows - 1)) for value in row)
    left, right = (int(np.clip(round(float(value)), 0, grid.cols - 1)) for value in col)
    thick = max(1, round(grid.rows / TILE_PX))
    image[top : top + thick, left : right + 1] = colour
    image[max(bottom - thick + 1, 0) : bottom + 1, left : right + 1] = colour
    image[top : bottom + 1, left : left + thick] = colour
    image[top : bottom + 1, max(right - thick + 1, 0) : right + 1] = colour
