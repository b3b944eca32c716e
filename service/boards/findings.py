"""The rows that an inspection lists: defects, regions, and areas that were not inspected."""

import csv
import io
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import find_objects, label

from service.boards.stitching.comparison import Deviation
from service.boards.stitching.grid import BoardGrid
from service.boards.stitching.regions import RegionResult
from service.boards.stitching.significance import Scan, core_of, grown, mean_of, weighted_centre

FINDINGS_FILE = "findings.csv"
MOST_AREAS = 1000
"""The most areas that are listed, the largest first; the report says how many there are."""
COLUMNS = ("kind", "name", "verdict", "x_m", "y_m", "width_m", "height_m", "area_m2", "pixels", "measured_pixels", "deviation_m", "sigma_m",
           "significance", "peak_m", "volume_m3", "tolerance_low_m", "tolerance_high_m")


class Area(NamedTuple):
    """A connected area of the board."""

    x_m: float
    y_m: float
    width_m: float
    height_m: float
    """Extent along y."""
    area_m2: float
    pixels: int


class Defect(NamedTuple):
    """A connected area with a significant deviation."""

    area: Area
    """Pixels whose smallest window has a mean of at least half the largest in the area; the middle is weighted by the deviation."""
    deviation_m: float
    sigma_m: float
    significance: float
    """The largest |mean| less tolerance over σ of the windows there."""
    peak_m: float
    """Largest mean deviation of a smallest window."""
    volume_m3: float


def find_defects(deviation: Deviation, scan: Scan) -> list[Defect]:
    """Return the significant areas, the most significant first; those nearer to each other than two smallest windows are one."""
    found = []
    for rows, cols, near in _connected(grown(scan.significant, 2 * scan.sides_px[0] + 1)):
        where = (rows, cols)
        part = near & scan.significant[where]
        inner = scan._replace(mean=scan.mean[where], mean_sigma=scan.mean_sigma[where], score=scan.score[where])
        core = core_of(inner, part & deviation.known[where])
        cut = Deviation(deviation.grid, deviation.height[where], deviation.variance[where], deviation.systematic[where])
        mean = mean_of(cut, core)
        if mean is None:
            continue
        row, col = np.nonzero(core)
        heights = cut.height[core]
        middle = weighted_centre(heights, row.astype(np.float64), col.astype(np.float64))
        area = _area(deviation.grid, row + rows.start, col + cols.start, (middle[0] + rows.start, middle[1] + cols.start))
        known = inner.mean[core & np.isfinite(inner.mean)]
        peak = float(known[np.abs(known).argmax()]) if known.size else mean.value
        found.append(Defect(area, mean.value, mean.sigma, float(inner.score[part].max()), peak,
                            float(heights.sum()) * deviation.grid.pixel_m**2))
    return sorted(found, key=lambda defect: -defect.significance)


def find_areas(grid: BoardGrid, pixels: np.ndarray) -> tuple[list[Area], int]:
    """Return the connected areas of some pixels, [rows, cols] bool, the largest MOST_AREAS first, and how many there are."""
    found = []
    for rows, cols, part in _connected(pixels):
        row, col = np.nonzero(part)
        found.append(_area(grid, row + rows.start, col + cols.start, (float(row.mean()) + rows.start, float(col.mean()) + cols.start)))
    found.sort(key=lambda area: -area.pixels)
    return found[:MOST_AREAS], len(found)


def findings_csv(defects: Sequence[Defect], regions: Sequence[RegionResult], areas: Sequence[Area]) -> str:
    """Return the table of all findings: one line for each defect, region and area not inspected."""
    out = io.StringIO()
    table = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    table.writeheader()
    for number, defect in enumerate(defects, start=1):
        table.writerow({"kind": "defect", "name": f"defect {number}", "verdict": "fail", **_numbers(defect.area._asdict()),
                        "measured_pixels": defect.area.pixels, **_numbers({key: getattr(defect, key) for key in (
                            "deviation_m", "sigma_m", "significance", "peak_m", "volume_m3")})})
    for result in regions:
        region = result.region
        table.writerow({"kind": "region", "name": region.name, "verdict": result.verdict, "pixels": result.pixels,
                        "measured_pixels": result.measured, **_numbers({
                            "x_m": region.centre_m[0], "y_m": region.centre_m[1], "width_m": region.size_m[0], "height_m": region.size_m[1],
                            "deviation_m": result.deviation_m, "sigma_m": result.sigma_m, "tolerance_low_m": region.tolerance_m[0],
                            "tolerance_high_m": region.tolerance_m[1]})})
    for number, area in enumerate(areas, start=1):
        table.writerow({"kind": "area", "name": f"area {number}", "verdict": "not inspected", **_numbers(area._asdict()),
                        "measured_pixels": 0})
    return out.getvalue()


def entries(defects: Sequence[Defect], regions: Sequence[RegionResult]) -> dict[str, Any]:
    """Return the defects and regions for a report."""
    return {
        "defects": [_numbers({**defect.area._asdict(), **{key: value for key, value in defect._asdict().items() if key != "area"}})
                    for defect in defects],
        "regions": [{"name": result.region.name, "verdict": str(result.verdict), "pixels": result.pixels, "measured": result.measured,
                     "tolerance_m": list(result.region.tolerance_m),
                     **_numbers({"deviation_m": result.deviation_m, "sigma_m": result.sigma_m})} for result in regions],
    }


def _connected(pixels: np.ndarray) -> Iterator[tuple[slice, slice, np.ndarray]]:
    """Yield the rows, the columns and the pixels within them of every connected area."""
    labels, _ = label(pixels)
    for number, (rows, cols) in enumerate(find_objects(labels), start=1):
        yield rows, cols, labels[rows, cols] == number


def _area(grid: BoardGrid, row: np.ndarray, col: np.ndarray, middle: tuple[float, float]) -> Area:
    x, y = grid.coordinates(np.array(middle[0]), np.array(middle[1]))
    pixel = grid.pixel_m
    return Area(float(x), float(y), float(np.ptp(col) + 1) * pixel, float(np.ptp(row) + 1) * pixel, row.size * pixel**2, int(row.size))


def _numbers(values: dict[str, Any]) -> dict[str, Any]:
    """Return values with floats of six digits."""
    return {key: float(f"{value:.6g}") if isinstance(value, float) else value for key, value in values.items()}
