"""LAS 1.4 with laspy, which `pip install 'relit[las]'` installs: point clouds of scans are written, and any are read."""

import json
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.errors import ResultError
from stage.files import replacing
from stage.formats.las_units import units_of

LAS_FILE = "points.las"
POINT_FORMAT = 6
"""The smallest point record of LAS 1.4: position, intensity, return number, and time."""
LEAST_SCALE_M = 1e-4
"""The unit of the integers in which LAS stores coordinates; it grows by factors of ten for clouds that are too large for it."""
LARGEST_NUMBER = 2**31 - 1
LARGEST_INTENSITY = 2**16 - 1
RECORD_OWNER, RECORD_ID = "relit", 1
"""The owner and the number of the record that holds the scale of intensity and the provenance as JSON."""
MOST_RETURNS = 15
"""The most returns of a shot that LAS can number."""
NOISE_CLASSES = (7, 18)
"""The classes of low points and high noise (LAS 1.4, table 17)."""
COORDINATES = ('LOCAL_CS["world of the scan",LOCAL_DATUM["world of the scan",0],UNIT["metre",1],'
               'AXIS["x",OTHER],AXIS["y",OTHER],AXIS["z",OTHER]]')
"""The coordinate system, which LAS 1.4 requires: coordinates are in the world frame of the track of the platform, not on a map."""


class LasPoints(NamedTuple):
    """The points of a file."""

    points: np.ndarray  # [n, 3] float64, in the units of the file
    colours: np.ndarray | None  # [n, 3] uint8
    units_m: tuple[float, float, float] | None
    """Metres in one unit of x, y and z; None: the file does not say it."""


class LasScales(NamedTuple):
    """The scales and the offset that turn the integers of a LAS file into coordinates and intensities."""

    scale_m: float
    offset_m: tuple[float, float, float]
    intensity_scale: float
    """The factor from an intensity in the file to the intensity of the scan."""


def las_is_installed() -> bool:
    """Return whether laspy is installed."""
    return find_spec("laspy") is not None


def write_las(points: np.ndarray, intensity: np.ndarray, time_s: np.ndarray, shot: np.ndarray, range_m: np.ndarray, path: str | Path, *,
              provenance: dict[str, str] | None = None) -> LasScales:
    """Write the points of a scan as a LAS file, whole or not at all.
    Returns the scale and the offset of the coordinates, and the scale of intensity.

    Args:
        points: [n, 3] float64 metres, world frame; the axes are written unchanged.
        intensity: [n]; negative values become 0. Integers up to 65535 are kept, other values are scaled to the largest.
        time_s: [n] time of the shot of each point, on the clock of the scan; written as gps_time (GPS week time: seconds, no date).
        shot: [n] index of the shot of each point; the points of one shot are numbered by their range, the nearest first.
        range_m: [n] the range of each point.
        provenance: texts that are kept in a record beside the scale of intensity.

    Source:
        ASPRS, "LAS Specification 1.4 - R15", 2019: point data record format 6.
    """
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    if len(points) == 0:
        raise ResultError(f"{path}: there is no point to write")
    low, high = points.min(axis=0), points.max(axis=0)
    offset = np.round(0.5 * (low + high))
    reach = float(np.maximum(high - offset, offset - low).max())
    scale = LEAST_SCALE_M * 10.0 ** max(0, int(np.ceil(np.log10(max(reach, 1e-9) / (LEAST_SCALE_M * LARGEST_NUMBER)))))
    most = float(intensity.max())
    whole = most <= LARGEST_INTENSITY and bool((intensity == np.rint(intensity)).all())
    intensity_scale = 1.0 if whole or most <= 0 else most / LARGEST_INTENSITY

    header = laspy.LasHeader(point_format=POINT_FORMAT, version="1.4")
    header.creation_date = None  # equal scans make equal files
    header.generating_software = "relit"
    header.global_encoding.wkt = True
    header.scales, header.offsets = np.full(3, scale), offset
    notes = {"intensity_scale": intensity_scale, **(provenance or {})}
    header.vlrs.append(WktCoordinateSystemVlr(COORDINATES))
    header.vlrs.append(laspy.VLR(RECORD_OWNER, RECORD_ID, "scale of intensity, provenance", json.dumps(notes, sort_keys=True).encode()))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.intensity = np.rint(np.clip(intensity / intensity_scale, 0, LARGEST_INTENSITY)).astype(np.uint16)
    las.gps_time = time_s
    number, count = _numbered(shot, range_m)
    las.return_number, las.number_of_returns = np.minimum(number, MOST_RETURNS), np.minimum(count, MOST_RETURNS)
    with replacing(path) as temporary:
        las.write(str(temporary))
    return LasScales(scale, (float(offset[0]), float(offset[1]), float(offset[2])), intensity_scale)


def _numbered(shot: np.ndarray, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the [n] number of each point among the points of its shot, 1 the nearest, and the [n] count of these points."""
    order = np.lexsort((range_m, shot))
    _, group, counts = np.unique(shot, return_inverse=True, return_counts=True)
    number = np.empty(len(shot), dtype=np.int64)
    number[order] = np.arange(len(shot)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    return number, counts[group]


def read_las(path: str | Path) -> LasPoints:
    """Read the points of a LAS or LAZ file, but those that are withheld or classified as noise.
    Raises ResultError if laspy is not installed, or the file is no LAS file, or a part of one."""
    if not las_is_installed():
        raise ResultError(f"{path}: LAS files need laspy: pip install 'relit[las]'")
    import laspy

    try:
        with laspy.open(path) as reader:
            promised = reader.header.point_count
            cloud = reader.read()
    except (laspy.errors.LaspyException, ValueError, EOFError) as error:
        raise ResultError(f"{path}: is no LAS file that laspy reads: {' '.join(str(error).split())}") from error
    if len(cloud.points) != promised:
        raise ResultError(f"{path}: is truncated: it holds {len(cloud.points)} of {promised} points")
    units_m = units_of([*cloud.header.vlrs, *(cloud.evlrs or [])])
    cloud = cloud[(np.asarray(cloud.withheld) == 0) & ~np.isin(np.asarray(cloud.classification), NOISE_CLASSES)]
    points = np.stack([np.asarray(cloud[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    names = set(cloud.point_format.dimension_names)
    if not {"red", "green", "blue"} <= names:
        return LasPoints(points, None, units_m)
    colours = np.stack([np.asarray(cloud[name]) for name in ("red", "green", "blue")], axis=1)
    return LasPoints(points, (colours >> (8 if colours.max(initial=0) > 255 else 0)).astype(np.uint8), units_m)
