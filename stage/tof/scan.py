"""A scan, schema relit.scan/1: laser shots in known directions from a platform that may move."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from stage.errors import CalibrationError, ImageError, ManifestError, storage
from stage.folders import advice
from stage.model import Count, Positive, Strict, Text
from stage.records import read_record
from stage.tof.raw_frames import read_array
from stage.transforms import Transform

FILE_NAME = "scan.json"
IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
DEGREES = 4 * np.pi
"""Azimuths beyond it are in degrees, or turns that were counted on, which do not come back."""
COLUMNS = "time_s, azimuth_rad, elevation_rad"


class Pose(Strict):
    """The pose of the platform at one time."""

    time_s: float
    world_from_platform: Transform


def _ascending(poses: tuple[Pose, ...]) -> tuple[Pose, ...]:
    for index in range(1, len(poses)):
        if not poses[index].time_s > poses[index - 1].time_s:
            raise ValueError(f"is out of order: pose {index} is not after pose {index - 1}")
    return poses


Track = Annotated[tuple[Pose, ...], Field(min_length=1), AfterValidator(_ascending)]
"""Poses in order of time; a single pose means a platform that stands still."""


def poses_at(track: tuple[Pose, ...], times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate the poses of a track at given times: positions linearly, rotations by slerp.
    `times_s`: [n] seconds, on the clock of the track. Returns rotation [n, 3, 3] and translation [n, 3] of world_from_platform, and covered
    [n] bool, which is False before the first and after the last pose. The nearest pose is returned there; a single pose covers all times.
    Raises CalibrationError if a time is not finite.

    Source:
        Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985.
    """
    if not np.isfinite(times_s).all():
        raise CalibrationError("a shot has a time that is not finite")
    known = np.array([pose.time_s for pose in track])
    matrices = np.array([pose.world_from_platform for pose in track], dtype=np.float64)
    if len(track) == 1:
        return (np.broadcast_to(matrices[0, :3, :3], (len(times_s), 3, 3)), np.broadcast_to(matrices[0, :3, 3], (len(times_s), 3)),
                np.ones(len(times_s), dtype=bool))
    from scipy.spatial.transform import Rotation, Slerp  # the API reads scans, and needs no poses

    turns = Rotation.from_matrix(matrices[:, :3, :3])
    within = np.clip(times_s, known[0], known[-1])
    translation = np.stack([np.interp(within, known, values) for values in matrices[:, :3, 3].T], axis=1)
    return Slerp(known, turns)(within).as_matrix(), translation, within == times_s


class Waveforms(Strict):
    """The photon histograms of the shots of a scan, which replace their ranges."""

    file: Text
    """A .npy file of (shots, bins)."""
    bin_s: Positive
    start_s: float = 0.0
    pulses: Count | None = None
    first_photon_only: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.first_photon_only and self.pulses is None:
            raise ValueError("pulses is missing: pile-up of a detector that counts first photons only is corrected with it")
        return self


class Scan(Strict):
    """The content of scan.json."""

    schema_: Literal["relit.scan/1"] = Field(alias="schema")
    name: Text
    shots: Text
    """A .npy file of (shots, 5): time_s, azimuth_rad, elevation_rad, range_m, intensity; with waveforms (shots, 3), the first three."""
    waveforms: Waveforms | None = None
    platform_from_scanner: Transform = IDENTITY
    track: Track = Field(default=(Pose(time_s=0.0, world_from_platform=IDENTITY),))
    """The poses of the platform; by default it stands still at the origin of the world."""


@dataclass(frozen=True)
class Shots:
    """The shots of a scan as arrays."""

    scan: Scan
    folder: Path
    time_s: np.ndarray  # [n] float64
    azimuth_rad: np.ndarray  # [n] float64, positive to the right
    elevation_rad: np.ndarray  # [n] float64, positive upwards
    range_m: np.ndarray | None  # [n] float64 metres; a value that is not finite or not above zero means no return
    intensity: np.ndarray | None  # [n] float64
    waveforms: np.ndarray | None  # [n, bins] float32


def read_scan(path: str | Path) -> Shots:
    """Read a scan; `path`: the folder of the scan, or the scan.json in it."""
    given = Path(path)
    folder = given.parent if given.name == FILE_NAME else given
    with storage("read", folder):
        if not (folder / FILE_NAME).is_file():
            advised = advice(folder, "`relit scan` takes the shots of a scanning laser")
            raise ManifestError(f"{folder}: holds no {FILE_NAME}: {advised}")
    scan = read_record(folder / FILE_NAME, Scan)
    for name in (scan.shots, *(() if scan.waveforms is None else (scan.waveforms.file,))):
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise ManifestError(f"{folder / FILE_NAME}: {name} leads out of the scan's folder")
    shots = read_array(folder / scan.shots)
    columns = 5 if scan.waveforms is None else 3
    if shots.ndim != 2 or shots.shape[1] != columns or len(shots) == 0:
        names = COLUMNS + (", range_m, intensity" if columns == 5 else "")
        raise ImageError(f"{folder / scan.shots}: is {shots.shape}, expected (shots, {columns}): {names}")
    values = shots.astype(np.float64).T
    if not np.isfinite(values[:3]).all():
        raise ImageError(f"{folder / scan.shots}: has times or angles that are not finite")
    if (reach := float(np.abs(values[2]).max())) > 2 * np.pi:
        raise ImageError(f"{folder / scan.shots}: elevation_rad reaches {reach:.3g}: give angles in radians")
    if (reach := float(np.abs(values[1]).max())) > DEGREES and (np.diff(values[1]) > 0).any() and (np.diff(values[1]) < 0).any():
        raise ImageError(f"{folder / scan.shots}: azimuth_rad reaches {reach:.3g}, to and fro: give angles in radians")
    if scan.waveforms is None:
        return Shots(scan, folder, values[0], values[1], values[2], values[3], values[4], None)
    waveforms = read_array(folder / scan.waveforms.file)
    if waveforms.ndim != 2 or len(waveforms) != len(shots) or waveforms.shape[1] < 3:
        raise ImageError(f"{folder / scan.waveforms.file}: is {waveforms.shape}, expected ({len(shots)}, bins), three bins or more")
    return Shots(scan, folder, values[0], values[1], values[2], None, None, waveforms.astype(np.float32))


def directions(azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> np.ndarray:
    """Return the unit directions of shots in the scanner frame: -z straight ahead, +x to the right, +y upwards, as in a camera frame.
    Returns [n, 3] float64."""
    flat = np.cos(elevation_rad)
    return np.stack([np.sin(azimuth_rad) * flat, np.sin(elevation_rad), -np.cos(azimuth_rad) * flat], axis=-1)


def world_points(shots: Shots, index: np.ndarray, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the world points of ranges, from the pose of the platform at the time of each shot.
    `index`: [m] the shot of each range; a shot may have several ranges. `range_m`: [m] metres. Returns [m, 3] float64 metres, world frame,
    and [m] bool: False where the track does not cover the time of the shot."""
    rotation, translation, covered = poses_at(shots.scan.track, shots.time_s[index])
    platform_from_scanner = np.array(shots.scan.platform_from_scanner, dtype=np.float64)
    in_scanner = directions(shots.azimuth_rad[index], shots.elevation_rad[index]) * range_m[:, None]
    on_platform = in_scanner @ platform_from_scanner[:3, :3].T + platform_from_scanner[:3, 3]
    return np.einsum("nij,nj->ni", rotation, on_platform) + translation, covered
