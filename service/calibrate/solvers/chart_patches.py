"""The patches of a colour chart in an image: a table of their reflectances, and the pixels that show each.

The chart is flat, so that a homography takes the centres of its patches to the image; four of them, at the corners, give it. Irradiance is
read on neutral patches alone: the light of narrow primaries meets the reflectance of a coloured patch at other wavelengths than its
red, green and blue stand for.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.errors import CalibrationError, ManifestError
from stage.formats.csv_table import read_table

COLUMNS = ("name", "r", "g", "b")
NEUTRAL = 0.05
"""The reflectances of a neutral patch differ by no more than this part of the largest."""
INNER = 0.25
"""The part of a patch that is read reaches so far from its centre, in spacings of patches: its edges may be shaded or blurred."""
FEWEST_PIXELS = 9
"""A patch is read from so many pixels at least."""


class ChartPatches(NamedTuple):
    """The patches of a chart in an image, or in a part of it."""

    label: np.ndarray  # [h, w] int, the index of the patch that a pixel shows; -1, which names the last row below, shows none
    names: tuple[str, ...]
    reflectance: np.ndarray  # [patches + 1, 3] float64, 0 to 1; the last row is 0
    neutral: np.ndarray  # [patches + 1] bool; the last is False
    box: tuple[slice, slice]
    """The part of the image, rows and columns."""

    def means(self, radiance: np.ndarray, saturated: np.ndarray | None) -> np.ndarray:
        """Return the mean [patches, 3] of each patch in the image [h, w, 3] of the box.
        Raises CalibrationError if a pixel of a patch is saturated."""
        inside = self.label >= 0
        label = self.label[inside]
        if saturated is not None and saturated[inside].any():
            raise CalibrationError(f"the patch {self.names[label[saturated[inside]][0]]} of the chart is saturated: shorten the exposure")
        sums = [np.bincount(label, channel) for channel in radiance[inside].astype(np.float64).T]
        return np.stack(sums, axis=1) / np.bincount(label)[:, None]


def find_patches(path: Path, grid: tuple[int, int], corners: np.ndarray, resolution: tuple[int, int]) -> ChartPatches:
    """Return the patches of a chart.
    `path`: a CSV file with the columns name, r, g, b: the linear reflectances of each patch in reading order. `corners`: [4, 2] the pixels
    (u, v), the first of the image being centred at (0.5, 0.5), of the centres of the first patch, the last of the first row, the last of
    the chart, and the first of the last row. `resolution`: the width and height of the images. Raises ManifestError if the table is wrong;
    names the line. Raises CalibrationError if the corners span no chart in the image, or its patches are too small."""
    names, reflectance = _read_reflectances(path, grid)
    places = place_patches(names, grid, corners, resolution)
    neutral = np.ptp(reflectance, axis=1) <= NEUTRAL * reflectance.max(axis=1)
    if not neutral.any():
        raise ManifestError(f"{path}: has no neutral patch, with equal r, g and b, from which irradiance could be read")
    return ChartPatches(places.label, names, np.concatenate([reflectance, np.zeros((1, 3))]), np.append(neutral, False), places.box)


class PatchPlaces(NamedTuple):
    """The pixels that show each patch, in a part of an image."""

    label: np.ndarray  # [h, w] int, the index of the patch that a pixel shows; -1 shows none
    quarter: np.ndarray  # [h, w] int, 0 to 3, the quarter of the patch
    box: tuple[slice, slice]
    """The part of the image, rows and columns."""


def place_patches(names: Sequence[str], grid: tuple[int, int], corners: np.ndarray, resolution: tuple[int, int]) -> PatchPlaces:
    """Return the pixels that show each patch of a chart; the arguments as in `find_patches`, names as errors have them.
    Raises CalibrationError if the corners span no chart in the image, or its patches are too small."""
    columns, rows = grid
    last = np.array([[0, 0], [columns - 1, 0], [columns - 1, rows - 1], [0, rows - 1]], dtype=float)
    # [u, v, 1] → [x, y, 1] of the grid up to a factor, with a last element of 1
    equations = [[[u, v, 1, 0, 0, 0, -x * u, -x * v], [0, 0, 0, u, v, 1, -y * u, -y * v]]
                 for (u, v), (x, y) in zip(corners, last, strict=True)]
    try:
        form = np.append(np.linalg.solve(np.reshape(equations, (8, 8)), last.ravel()), 1.0).reshape(3, 3)
        centres = np.linalg.inv(form) @ np.stack([*np.indices((columns, rows)).reshape(2, -1), np.ones(columns * rows)])
    except np.linalg.LinAlgError as error:
        raise CalibrationError("--corners: three of them lie on a line, or two are the same") from error
    centres = centres[:2] / centres[2]
    width, height = resolution
    if not ((centres >= 0).all() and (centres.max(axis=1) <= (width, height)).all()):
        raise CalibrationError(f"--corners: the patches between them lead out of the images, which are {width}x{height}")
    (left, top), (right, bottom) = np.floor(centres.min(axis=1)).astype(int), np.ceil(centres.max(axis=1)).astype(int)
    reach = max(right - left, bottom - top) // min(grid)
    box = slice(max(top - reach, 0), min(bottom + reach + 1, height)), slice(max(left - reach, 0), min(right + reach + 1, width))
    v, u = np.mgrid[box] + 0.5
    place = form @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    place = place[:2] / place[2]
    nearest = np.rint(place).astype(int)
    off = place - nearest
    shown = (np.abs(off).max(axis=0) < INNER) & (nearest >= 0).all(axis=0) & (nearest < np.array(grid)[:, None]).all(axis=0)
    label = np.where(shown, nearest[1] * columns + nearest[0], -1).reshape(u.shape)
    counts = np.bincount(label[label >= 0], minlength=len(names))
    if counts.min() < FEWEST_PIXELS:
        raise CalibrationError(f"the patch {names[int(counts.argmin())]} of the chart has {counts.min()} pixels, {FEWEST_PIXELS} are "
                               "needed: check --corners and the number of patches, or go nearer")
    return PatchPlaces(label, (2 * (off[1] > 0) + (off[0] > 0)).reshape(u.shape), box)


def _read_reflectances(path: Path, grid: tuple[int, int]) -> tuple[tuple[str, ...], np.ndarray]:
    rows = read_table(path, COLUMNS)
    names, values = [], []
    for row in rows:
        try:
            values.append([float(row[channel]) for channel in COLUMNS[1:]])
        except (TypeError, ValueError) as error:
            raise ManifestError(f"{path}: line {rows.line_num}: r, g and b must be numbers from 0 to 1") from error
        if not all(0 < value <= 1 for value in values[-1]):
            raise ManifestError(f"{path}: line {rows.line_num}: r, g and b must be above 0 and at most 1")
        names.append((row["name"] or "").strip())
    if len(names) != grid[0] * grid[1]:
        raise ManifestError(f"{path}: has {len(names)} patches, --grid {grid[0]},{grid[1]} has {grid[0] * grid[1]}")
    return tuple(names), np.array(values)
