"""Measure the size of scans, and the scale at which each is compared with others."""

from collections.abc import Mapping, Sequence

import numpy as np

from service.scans.points.scan import Scan
from service.scans.registration.diagnosis import odd_scans
from stage.errors import ScanError

CELLS_ACROSS = 60
"""The extent of a scan in cells of the rough scale: some 1500 cells of a surface are occupied."""
SMALLER = 3.0
"""A scan with a start whose extent is this many times smaller or larger than usual is compared with others at a scale of its own."""


def extent_of(scan: Scan) -> float:
    """Return the diagonal of the box around nearly all points of a scan, metres."""
    low, high = np.percentile(scan.points, (1, 99), axis=0)
    extent = float(np.linalg.norm(high - low))
    if extent == 0:
        raise ScanError(f"{scan.name}: nearly all of its {len(scan.points)} points lie at one place: check {scan.path}")
    return extent


def usual_extent(extents: Sequence[float]) -> float:
    """Return the median extent of the scans that are not far larger or smaller than most, metres."""
    odd = odd_scans(extents)
    return float(np.median([extent for number, extent in enumerate(extents) if number not in odd]))


def cells_of(extents: Sequence[float], starts: Sequence[np.ndarray | None], cell_m: float | None) -> Mapping[int, float]:
    """Return the side of the cells of the rough scale of each scan that can be registered, metres.

    There is one side for all scans of about one extent: `cell_m`, or a sixtieth of their usual extent. A scan that is far smaller or larger
    and has a start has another, that times the nearest power of two; a scan so far off that its unit may be wrong is left out if it has
    none.
    """
    odd, usual = odd_scans(extents), usual_extent(extents)
    common = cell_m or usual / CELLS_ACROSS
    cells = {}
    for number, extent in enumerate(extents):
        if starts[number] is None or 1 / SMALLER < extent / usual < SMALLER:
            if number not in odd:
                cells[number] = common
        else:
            cells[number] = common * 2.0 ** round(float(np.log2(extent / usual)))
    return cells
