"""The rows that an inspection lists: defects, regions, and areas that were not inspected; and tables of boards as CSV."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import find_objects, label

from service.boards.stitching.grid import BoardGrid, HeightMap
from service.boards.stitching.regions import RegionResult
from service.boards.stitching.significance import Scan, grown, mean_of, region_of, weighted_centre
from stage.formats.csv_table import table_text


def six_digits(value: float) -> float:
    """Return a number rounded to six digits."""
    return float(f"{value:.6g}")


def rounded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values whose floats have six digits."""
    return {key: six_digits(value) if isinstance(value, float) else value for key, value in values.items()}


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
    """The connected pixels that deviate by at least half of the largest mean there; the middle is weighted by the deviation."""
    deviation_m: float
    """Mean of these pixels, weighted by their variance."""
    sigma_m: float
    significance: float
    """|deviation_m| less the tolerance over sigma_m."""
    peak_m: float
    """The deviation that a twentieth of the pixels exceed."""
    volume_m3: float


def find_defects(deviation: HeightMap, scan: Scan, tolerance_m: np.ndarray) -> tuple[list[Defect], np.ndarray]:
    """Return the significant areas, the most significant first, and their pixels, [rows, cols] bool.

    Areas to one side that are nearer to each other than two smallest windows are one. An area whose own mean is not significant, because
    the windows over it hold other pixels too, is no defect.
    """
    found, taken = [], np.zeros(scan.side.shape, dtype=bool)
    for sign in (1, -1):
        for rows, cols, near in _connected(grown(sign * scan.side > 0, 2 * scan.sides_px[0] + 1)):
            part = near & (sign * scan.side[rows, cols] > 0)
            if (taken[rows, cols] & part).sum() > part.sum() / 2:
                continue  # an area that was found from another part of it
            where, core = _region(deviation, scan, (rows, cols), part)
            for pixels in (core, core & (sign * scan.side[where] > 0)):
                defect = _defect(deviation, scan, tolerance_m, where, pixels)
                if defect is not None and sign * defect.deviation_m > 0 and defect.significance >= scan.threshold:
                    found.append(defect)
                    taken[where] |= pixels
                    break
    return sorted(found, key=lambda defect: -defect.significance), taken


def _region(deviation: HeightMap, scan: Scan, box: tuple[slice, slice], part: np.ndarray) -> tuple[tuple[slice, slice], np.ndarray]:
    """Return the whole area that a significant part of a box belongs to: the rows and columns of a box around it, and its pixels there."""
    rows, cols = scan.side.shape
    grow = 2 * scan.sides_px[-1]
    while True:
        where = (slice(max(box[0].start - grow, 0), min(box[0].stop + grow, rows)),
                 slice(max(box[1].start - grow, 0), min(box[1].stop + grow, cols)))
        cut = deviation.cut(where)
        top, left = box[0].start - where[0].start, box[1].start - where[1].start
        inside = np.zeros(cut.height.shape, dtype=bool)
        inside[top : top + part.shape[0], left : left + part.shape[1]] = part
        region = region_of(cut, scan._replace(side=scan.side[where]), inside)
        if not any((region[0].any() and where[0].start > 0, region[-1].any() and where[0].stop < rows,
                    region[:, 0].any() and where[1].start > 0, region[:, -1].any() and where[1].stop < cols)):
            return where, region
        grow *= 4


def _defect(deviation: HeightMap, scan: Scan, tolerance_m: np.ndarray, where: tuple[slice, slice], pixels: np.ndarray) -> Defect | None:
    """Return what is said of some pixels of a box; None of no pixel."""
    cut = deviation.cut(where)
    factor = max(value for side, value in scan.spread.items() if side == scan.sides_px[0] or side * side <= pixels.sum())
    mean = mean_of(cut, pixels, spread=factor)
    if mean is None:
        return None
    row, col = np.nonzero(pixels)
    heights = cut.height[pixels]
    middle = weighted_centre(heights, row.astype(np.float64), col.astype(np.float64))
    area = _area(deviation.grid, row + where[0].start, col + where[1].start, (middle[0] + where[0].start, middle[1] + where[1].start))
    allowed = float(tolerance_m[where][pixels].mean())
    peak = float(np.percentile(heights, 95 if mean.value > 0 else 5))
    volume = float(heights.sum()) * deviation.grid.pixel_m**2
    return Defect(area, mean.value, mean.sigma, (abs(mean.value) - allowed) / mean.sigma, peak, volume)


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
    rows: list[dict[str, Any]] = []
    for number, defect in enumerate(defects, start=1):
        rows.append({"kind": "defect", "name": f"defect {number}", "verdict": "fail", **rounded(defect.area._asdict()),
                     "measured_pixels": defect.area.pixels, **rounded({key: getattr(defect, key) for key in (
                         "deviation_m", "sigma_m", "significance", "peak_m", "volume_m3")})})
    for result in regions:
        region = result.region
        rows.append({"kind": "region", "name": region.name, "verdict": result.verdict, "pixels": result.pixels,
                     "measured_pixels": result.measured, **rounded({
                         "x_m": region.centre_m[0], "y_m": region.centre_m[1], "width_m": region.size_m[0], "height_m": region.size_m[1],
                         "deviation_m": result.deviation_m, "sigma_m": result.sigma_m, "tolerance_low_m": region.tolerance_m[0],
                         "tolerance_high_m": region.tolerance_m[1]})})
    for number, area in enumerate(areas, start=1):
        rows.append({"kind": "area", "name": f"area {number}", "verdict": "not inspected", **rounded(area._asdict()),
                     "measured_pixels": 0})
    return table_text(COLUMNS, ([row.get(column) for column in COLUMNS] for row in rows))


def entries(defects: Sequence[Defect], regions: Sequence[RegionResult]) -> dict[str, Any]:
    """Return the defects and regions for a report."""
    return {
        "defects": [rounded({**defect.area._asdict(), **{key: value for key, value in defect._asdict().items() if key != "area"}})
                    for defect in defects],
        "regions": [{"name": result.region.name, "verdict": str(result.verdict), "pixels": result.pixels, "measured": result.measured,
                     "tolerance_m": list(result.region.tolerance_m),
                     **rounded({"deviation_m": result.deviation_m, "sigma_m": result.sigma_m})} for result in regions],
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
