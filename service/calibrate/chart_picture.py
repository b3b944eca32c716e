"""The picture of a calibration by a colour chart: the photograph, and each patch as it was measured, should be, and is corrected."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.calibrate.solvers.chart_colors import ChartColors
from service.calibrate.solvers.chart_reference import ChartReference
from service.calibrate.solvers.cielab import xyz_from_linear
from service.relight.sheet import BACKGROUND, display, write_sheet
from stage.colour.colour_spaces import Review

PICTURE_FILE = "chart.png"
PATCH, GAP = 42, 6
"""The side of a patch in the picture, and the gap between two, pixels."""
AROUND = 0.15
"""The part of the chart's width that is shown around it."""
WHITE = 0.9
"""The value that the brightest patch has in the photograph."""
MOST_ROWS = 480
"""The most rows of the photograph in the picture, before it is scaled to the height of the others."""


def write_picture(path: Path, photograph: np.ndarray, corners: np.ndarray, chart: ChartReference, found: Sequence[tuple[str, ChartColors]],
                  space: str, review: Review) -> Path:
    """Write the picture, and return its path.

    Args:
        photograph: [rows, cols, 3] linear, in the colours of the camera.
        corners: [4, 2] pixels of the centres of the corner patches.
        found: the title and the colours of each kind of light.
        space: the working space of the capture.
        review: the view through which colours are shown.
    """
    reach = AROUND * float(np.ptp(corners, axis=0).max())
    (left, top), (right, bottom) = np.maximum(corners.min(axis=0) - reach, 0).astype(int), (corners.max(axis=0) + reach).astype(int) + 1
    step = -(-(bottom - top) // MOST_ROWS)
    part = photograph[top:bottom:step, left:right:step]
    reference = chart.xyz @ np.linalg.inv(xyz_from_linear(space)).T
    v, u = np.indices(part.shape[:2]) * step
    sides = np.stack([(b[0] - a[0]) * (v + top - a[1]) - (b[1] - a[1]) * (u + left - a[0])
                      for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    on_chart = (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
    rows = []
    for title, colors in found:
        through = np.maximum(part @ colors.matrix.T, 0)
        shown = WHITE * through / max(float(np.percentile(through[on_chart], 99)), 1e-30)
        rows.append([(title, display(shown.astype(np.float32), space, review)),
                     ("measured | reference | corrected", _patches(colors, reference, chart.grid, space, review))])
    write_sheet(path, rows)
    return path


def _patches(colors: ChartColors, reference: np.ndarray, grid: tuple[int, int], space: str, review: Review) -> np.ndarray:
    """Return display values of the patches, each in three stripes; those that are left out have the reference alone."""
    columns, rows = grid
    pitch = PATCH + GAP
    sheet = np.tile(BACKGROUND, (rows * pitch - GAP, columns * pitch - GAP, 1))
    stripes = display(np.clip(np.stack([colors.measured, reference, colors.corrected]), 1e-6, None).astype(np.float32), space, review)
    for index in range(columns * rows):
        row, column = divmod(index, columns)
        for stripe in range(3) if index not in colors.refused else (1,):
            begin = column * pitch + stripe * PATCH // 3
            sheet[row * pitch : row * pitch + PATCH, begin : begin + PATCH // 3] = stripes[stripe, index]
    return sheet
