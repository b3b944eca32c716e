"""E57 (ASTM E2807) with pye57, which `pip install 'relit[e57]'` installs: scans with the places and poses of their scanners, in metres."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stage.errors import ResultError
from stage.transforms import scaled_rotation

AXES = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLOURS = ("colorRed", "colorGreen", "colorBlue")


class E57Scan(NamedTuple):
    """One scan of a file."""

    points: np.ndarray  # [n, 3] float64, metres, in the frame of the scanner where there is a pose
    colours: np.ndarray | None  # [n, 3] float64, from 0 to 1, 255 or 65535, as in the file
    pose: np.ndarray | None  # [4, 4] world from scanner, stretched by the square of its quaternion; None: the file says none


def read_e57(path: Path) -> Iterator[E57Scan]:
    """Yield the scans of an E57 file, without places at which the scanner saw nothing.
    Raises ResultError if pye57 is not installed, or the file is none that it reads; damaged pages are found by their checksums."""
    if find_spec("pye57") is None:
        raise ResultError(f"{path}: E57 files need pye57: pip install 'relit[e57]'")
    import pye57

    class File(pye57.E57):  # type: ignore[misc]
        """A file whose colours are read as they are: pye57 itself reads them into bytes, which hold no 16 bits and no parts of 1."""

        def make_buffer(self, field_name: str, capacity: int, do_conversion: bool = True, do_scaling: bool = True) -> Any:
            if field_name not in COLOURS:
                return super().make_buffer(field_name, capacity, do_conversion, do_scaling)
            values = np.empty(capacity, np.float64)
            return values, pye57.libe57.SourceDestBuffer(self.image_file, field_name, values, capacity, do_conversion, do_scaling)

    try:
        with File(str(path)) as file:
            for number in range(file.scan_count):
                header = file.get_header(number)
                if not any(all(name in header.point_fields for name in axes) for axes in (AXES, SPHERICAL)):
                    raise ValueError(f"scan {number} has neither {', '.join(AXES)} nor {', '.join(SPHERICAL)}")
                coloured = all(name in header.point_fields for name in COLOURS)
                values = file.read_scan(number, colors=coloured, transform=False, ignore_missing_fields=True)
                pose = None
                if header.has_pose():
                    pose = np.eye(4)
                    pose[:3, :3] = scaled_rotation(np.roll(header.rotation, -1))  # E57 has w first
                    pose[:3, 3] = header.translation
                yield E57Scan(_points(values), np.stack([values[name] for name in COLOURS], axis=1) if coloured else None, pose)
    except (pye57.libe57.E57Exception, ValueError, RuntimeError, KeyError) as error:
        reason = str(error).partition("\n")[0]
        raise ResultError(f"{path}: is no E57 file that pye57 reads: {reason}") from error


def _points(values: dict[str, np.ndarray]) -> np.ndarray:
    """Return points [n, 3] of cartesian or spherical coordinates (ASTM E2807, 8.4.4)."""
    if all(name in values for name in AXES):
        return np.stack([values[name] for name in AXES], axis=1).astype(np.float64)
    reach, around, up = (values[name].astype(np.float64) for name in SPHERICAL)
    return np.stack([reach * np.cos(up) * np.cos(around), reach * np.cos(up) * np.sin(around), reach * np.sin(up)], axis=1)
