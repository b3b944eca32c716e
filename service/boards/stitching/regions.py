"""Test whether the regions of a design are within their tolerances, decided by σ (ISO 14253-1)."""

from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from service.boards.stitching.grid import BoardGrid, HeightMap
from service.boards.stitching.significance import mean_of, threshold
from stage.sets.board import Region


class Verdict(StrEnum):
    """The decision about a region or a board."""

    PASS = "pass"
    """Within the tolerance, by more than the uncertainty."""
    FAIL = "fail"
    """Outside of the tolerance, by more than the uncertainty."""
    UNDECIDED = "undecided"
    """So near to a limit that the uncertainty does not tell."""
    NOT_INSPECTED = "not inspected"
    """Too few of its pixels are measured."""

    @classmethod
    def of(cls, value: float, sigma: float, limits: tuple[float, float], k: float) -> "Verdict":
        """Decide about a measured value; `k`: the standard deviations by which it must be within its limits, or outside."""
        low, high = limits
        if value < low - k * sigma or value > high + k * sigma:
            return cls.FAIL
        return cls.PASS if low + k * sigma <= value <= high - k * sigma else cls.UNDECIDED

    @classmethod
    def worst(cls, verdicts: Iterable["Verdict"]) -> "Verdict":
        """Return the verdict about a whole whose parts have these; a part that fails counts before one that was not inspected."""
        return min(verdicts, key=[cls.FAIL, cls.NOT_INSPECTED, cls.UNDECIDED, cls.PASS].index, default=cls.PASS)


class RegionResult(NamedTuple):
    """Verdict and measured deviation of a region."""

    region: Region
    verdict: Verdict
    deviation_m: float | None
    sigma_m: float | None
    pixels: int
    """Pixels of the grid that lie within the region."""
    measured: int
    """Number of these pixels that have a deviation."""


def pixels_of(region: Region, grid: BoardGrid, *, grow: float = 0.0) -> tuple[tuple[slice, slice], np.ndarray]:
    """Return the rows and columns around a region, made larger by the part `grow` of its size, and within them the pixels whose centres it
    holds."""
    (x, y), (width, height) = region.centre_m, (size * (1 + grow) for size in region.size_m)
    top, left = grid.place(np.array(x - width / 2), np.array(y + height / 2))
    bottom, right = grid.place(np.array(x + width / 2), np.array(y - height / 2))
    rows = slice(int(np.clip(np.ceil(top), 0, grid.rows)), int(np.clip(np.floor(bottom) + 1, 0, grid.rows)))
    cols = slice(int(np.clip(np.ceil(left), 0, grid.cols)), int(np.clip(np.floor(right) + 1, 0, grid.cols)))
    row, col = np.mgrid[rows, cols]
    px, py = grid.coordinates(row, col)
    if region.shape == "circle":
        return (rows, cols), ((px - x) / width) ** 2 + ((py - y) / height) ** 2 <= 0.25
    return (rows, cols), np.ones(px.shape, dtype=bool)


def tolerances_over(grid: BoardGrid, regions: Sequence[Region], *, elsewhere_m: float) -> np.ndarray:
    """Return the deviation that is no defect at each pixel, [rows, cols] metres: `elsewhere_m`, or the wider limit of a region."""
    out = np.full((grid.rows, grid.cols), elsewhere_m)
    for region in regions:
        where, inside = pixels_of(region, grid)
        wide = max(abs(limit) for limit in region.tolerance_m)
        out[where] = np.where(inside, np.maximum(out[where], wide), out[where])
    return out


def too_wide(nominal: HeightMap, regions: Sequence[Region], *, elsewhere_m: float, smallest_m: float) -> list[str]:
    """Return a sentence for limits that allow more than all of the relief, and than what they are for is wide: of another unit, or in order
    to leave a region out.
    `elsewhere_m`: deviation that is allowed anywhere. `smallest_m`: side of the smallest defect."""
    relief = float(np.nanmax(nominal.height) - np.nanmin(nominal.height))
    wide = [region for region in regions if min(-region.tolerance_m[0], region.tolerance_m[1]) > max(relief, *region.size_m)]
    said = [f"--tolerance-m allows {elsewhere_m:g} m, more than the {relief:.3g} m of relief: what is missing is no defect; give metres"
            ] if elsewhere_m > max(relief, smallest_m) else []
    if wide:
        low, high = wide[0].tolerance_m
        said.append(f"regions: {len(wide)}, as {wide[0].name}, allow {low:g} to {high:g} m, more than the {relief:.3g} m of "
                    "relief and than they are wide: nothing can fail there; tolerance_m is in metres")
    return said


def check_regions(deviation: HeightMap, regions: Sequence[Region], *, false_alarm: float, least_inspected: float
                  ) -> tuple[list[RegionResult], float]:
    """Decide about every region; `least_inspected`: the least part of the pixels of those that do not say it.

    With k the threshold of as many one-sided tests as there are limits, a region fails if its mean deviation is more than k σ outside of
    a limit, and passes if it is more than k σ inside of both. So the probability that any region of a good board fails, and the
    probability that any region outside its tolerance passes, are both at most `false_alarm`. The results come with k.
    """
    k = threshold(false_alarm, 2 * len(regions), sides=1)
    taken = np.zeros((deviation.grid.rows, deviation.grid.cols), dtype=bool)
    for region in regions:
        where, inside = pixels_of(region, deviation.grid)
        taken[where] |= inside
    return [_decide(deviation, region, taken, k, least_inspected if region.least_inspected is None else region.least_inspected)
            for region in regions], k


def _decide(deviation: HeightMap, region: Region, taken: np.ndarray, k: float, least: float) -> RegionResult:
    where, inside = pixels_of(region, deviation.grid)
    part = deviation.cut(where)
    mean, count = mean_of(part, inside), int(inside.sum())
    width, height = region.size_m  # without the border of the grid
    expected = width * height * (np.pi / 4 if region.shape == "circle" else 1.0) / deviation.grid.pixel_m**2 * 0.9
    if mean is None or mean.pixels < least * max(expected, 1.0):
        return RegionResult(region, Verdict.NOT_INSPECTED, None, None, count, 0 if mean is None else mean.pixels)
    value, sigma = mean.value, mean.sigma
    if region.datum == "surround":
        around, ring = pixels_of(region, deviation.grid, grow=1.0)
        whole = deviation.cut(around)
        datum = mean_of(whole, ring & ~taken[around])
        if datum is None or datum.pixels < least * max(int((ring & ~taken[around]).sum()), 1):
            return RegionResult(region, Verdict.NOT_INSPECTED, None, None, count, mean.pixels)
        value, sigma = value - datum.value, float(np.hypot(sigma, datum.sigma))
    return RegionResult(region, Verdict.of(value, sigma, region.tolerance_m, k), value, sigma, count, mean.pixels)
