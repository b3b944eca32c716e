"""The frames of a depth camera as they are published: which depth image goes with which colour image and pose, and the intrinsics.

- Beside each other: NAME.depth.png, NAME.color.jpg, NAME.pose.txt and camera-intrinsics.txt, as 7-Scenes and tsdf-fusion have them.
- TUM RGB-D (Sturm 2012): depth.txt and rgb.txt list `time file`, groundtruth.txt `time tx ty tz qx qy qz qw`, the pose of the camera in the
  world; a depth is 1/5000 m. Times of the three differ; what lies within .02 s belongs together, as in the authors' associate.py.
- Redwood and Open3D: folders depth and color (or image, or rgb), a trajectory .log with three numbers, the last of which counts the depth
  images from 1, before each 4 x 4 world_from_camera, and a JSON with width, height and the intrinsic matrix by columns; a depth is 1 mm.

All poses are those of cameras with the axes of OpenCV, and centres of pixels have whole numbers."""

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.errors import ManifestError, storage
from stage.folders import natural_order
from stage.importers.layout import image_names, read_json, read_lines
from stage.sets.scan_set import MOST_OFF_ROTATION
from stage.transforms import rigid_fault, scaled_rotation

DEPTH = ".depth.png"
INTRINSICS = "camera-intrinsics.txt"
TUM_LIST, TUM_COLOURS, TUM_POSES = "depth.txt", "rgb.txt", "groundtruth.txt"
TUM_APART_S = 0.02
"""Images and poses that belong together are at most so far apart, seconds."""
COLOUR_FOLDERS = ("color", "image", "rgb")
TRAJECTORY = "trajectory.log"


class FrameLayout(StrEnum):
    """How the frames of a depth camera lie in a folder."""

    BESIDE = "frames beside each other"
    TUM = "frames of the TUM RGB-D benchmark"
    REDWOOD = "frames of Redwood or Open3D"

    @property
    def unit_m(self) -> float:
        """Metres in one unit of a depth image, where nothing else is said."""
        return 1 / 5000 if self is FrameLayout.TUM else 0.001


class Frame(NamedTuple):
    """One frame of a depth camera."""

    name: str
    depth: Path
    colour: Path | None
    pose: np.ndarray | None
    """World from camera in the axes of OpenCV, [4, 4], as the file has it."""


def frame_layout(folder: Path) -> FrameLayout | None:
    """Return how frames of a depth camera lie in a folder, or None where there are none."""
    with storage("read", folder):
        names = [path.name for path in folder.iterdir()]
    if any(name.lower().endswith(DEPTH) for name in names):
        return FrameLayout.BESIDE
    if not (folder / "depth").is_dir():
        return None
    if TUM_LIST in names:
        return FrameLayout.TUM
    told = any((folder / name).is_dir() for name in COLOUR_FOLDERS) or any(name.lower().endswith(".log") for name in names)
    return FrameLayout.REDWOOD if told and _depth_names(folder / "depth") else None


def read_frames(folder: Path, layout: FrameLayout, poses: Path | None = None) -> list[Frame]:
    """Return the frames of a folder in their order. `poses`: the file of all poses; None: that of the folder, where there is one.
    Raises ManifestError: a list or a pose is wrong; names the file."""
    if layout is FrameLayout.BESIDE:
        with storage("read", folder):
            names = natural_order(path.name for path in folder.iterdir() if path.name.lower().endswith(DEPTH))
        if poses is not None:
            raise ManifestError(f"{poses}: {folder} has NAME{DEPTH} images, whose poses are in NAME.pose.txt")
        stems = [name[: -len(DEPTH)] for name in names]
        return [Frame(stem, folder / name, next((path for ending in ("jpg", "png", "jpeg")
                                                 if (path := folder / f"{stem}.color.{ending}").is_file()), None),
                      read_matrix(folder / f"{stem}.pose.txt", 4)) for stem, name in zip(stems, names, strict=True)]
    return _tum(folder, poses) if layout is FrameLayout.TUM else _redwood(folder, poses)


def read_intrinsics(folder: Path) -> np.ndarray | None:
    """Return the matrix [3, 3] of the depth camera of camera-intrinsics.txt, or of a JSON with intrinsic_matrix; None without either.
    Raises ManifestError: the file is wrong, or several files differ."""
    if (written := read_matrix(folder / INTRINSICS, 3)) is not None:
        return written
    found: dict[str, np.ndarray] = {}
    with storage("read", folder):
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".json" and path.is_file())
    for path in paths:
        data = read_json(path)
        if not isinstance(data, dict) or "intrinsic_matrix" not in data:
            continue
        try:
            values = np.array(data["intrinsic_matrix"], dtype=np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        matrix = values.reshape(3, 3).T if values.shape == (9,) else np.zeros((3, 3))
        if not np.isfinite(matrix).all() or not np.array_equal(matrix[2], (0, 0, 1)) or min(matrix[0, 0], matrix[1, 1]) <= 0:
            raise ManifestError(f"{path}: intrinsic_matrix: must be fx, 0, 0, 0, fy, 0, cx, cy, 1, the columns of the matrix")
        found[path.name] = matrix
    if len({matrix.tobytes() for matrix in found.values()}) > 1:
        raise ManifestError(f"{folder}: {' and '.join(found)} have intrinsics that differ: keep that of the depth camera")
    return next(iter(found.values()), None)


def pose_of(words: Sequence[str]) -> np.ndarray | None:
    """Return the pose [4, 4] of tx ty tz qx qy qz qw, stretched as its quaternion; None if it is no rotation and translation."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        return None
    if len(values) != 7 or not np.isfinite(values).all() or not values[3:].any():
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = scaled_rotation(values[3:]), values[:3]
    return pose if rigid_fault(pose, MOST_OFF_ROTATION) is None else None


def read_matrix(path: Path, size: int) -> np.ndarray | None:
    """Return a matrix of numbers in a text file, or None where there is no file."""
    return _matrix(path, [line for _, line in read_lines(path)], size) if path.is_file() else None


def _matrix(path: Path, lines: list[str], size: int) -> np.ndarray:
    try:
        matrix = np.array([[float(word) for word in line.replace(",", " ").split()] for line in lines])
    except ValueError:
        matrix = np.empty(0)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise ManifestError(f"{path}: must hold a matrix of {size} x {size} numbers")
    return matrix


def _depth_names(folder: Path) -> list[str]:
    return [name for name in image_names(folder) if name.lower().endswith(".png")]


def _tum(folder: Path, poses: Path | None) -> list[Frame]:
    times, files = _timed(folder / TUM_LIST, 1)
    colour_times, colours = _timed(folder / TUM_COLOURS, 1) if (folder / TUM_COLOURS).is_file() else (np.empty(0), [])
    table = poses or folder / TUM_POSES
    pose_times, rows = _timed(table, 7) if table.is_file() or poses else (np.empty(0), [])
    placed = []
    for row in rows:
        placed.append(pose_of(row))
        if placed[-1] is None:
            raise ManifestError(f"{table}: {' '.join(row)}: must be tx ty tz qx qy qz qw, with a quaternion of length 1")
    frames = []
    for time, (name,) in zip(times, files, strict=True):
        colour, pose = _nearest(colour_times, time), _nearest(pose_times, time)
        frames.append(Frame(Path(name).stem, folder / name, None if colour is None else folder / colours[colour][0],
                            None if pose is None else placed[pose]))
    return frames


def _timed(path: Path, columns: int) -> tuple[np.ndarray, list[list[str]]]:
    """Return the times of the lines of a list, and the words after them."""
    times, rows = [], []
    for number, line in read_lines(path):
        if line.startswith("#"):
            continue
        first, *words = line.replace(",", " ").split() or [""]
        try:
            time = float(first)
        except ValueError:
            time = float("nan")
        if len(words) != columns or not np.isfinite(time):
            what = "tx ty tz qx qy qz qw" if columns > 1 else "a file"
            raise ManifestError(f"{path}: line {number}: must be a time and {what}")
        times.append(time)
        rows.append(words)
    if not times:
        raise ManifestError(f"{path}: holds no line with a time")
    return np.array(times), rows


def _nearest(times: np.ndarray, time: float) -> int | None:
    """Return the number of the time nearest to one, or None if none is near."""
    number = int(np.abs(times - time).argmin()) if len(times) else 0
    return number if len(times) and abs(times[number] - time) <= TUM_APART_S else None


def _redwood(folder: Path, poses: Path | None) -> list[Frame]:
    depths = _depth_names(folder / "depth")
    inside = next((folder / name for name in COLOUR_FOLDERS if (folder / name).is_dir()), None)
    colours = [] if inside is None else image_names(inside)
    if colours and len(colours) != len(depths):
        raise ManifestError(f"{inside}: holds {len(colours)} images, and {folder / 'depth'} {len(depths)}: each depth has one of colours")
    with storage("read", folder):
        logs = [path for path in folder.iterdir() if path.suffix.lower() == ".log"]
    table = poses or next((path for path in logs if path.name.lower() == TRAJECTORY), logs[0] if len(logs) == 1 else None)
    if table is None and logs:
        raise ManifestError(f"{folder}: has {len(logs)} .log files: name that of the poses, --poses FILE")
    placed = {} if table is None else _trajectory(table, len(depths))
    return [Frame(Path(name).stem, folder / "depth" / name, inside / colours[number] if inside is not None and colours else None,
                  placed.get(number)) for number, name in enumerate(depths)]


def _trajectory(path: Path, count: int) -> dict[int, np.ndarray]:
    """Return world_from_camera of depth images, by their number from 0."""
    lines = [line for _, line in read_lines(path) if not line.startswith("#")]
    poses: dict[int, np.ndarray] = {}
    if not lines or len(lines) % 5:
        raise ManifestError(f"{path}: must hold five lines for each pose: three whole numbers, and a 4 x 4 matrix")
    for first in range(0, len(lines), 5):
        words = lines[first].split()
        number = int(words[2]) - 1 if len(words) == 3 and all(word.isdecimal() for word in words) else -1
        if not 0 <= number < count or number in poses:
            raise ManifestError(f"{path}: {lines[first]}: must be three whole numbers, the last that of a depth image, 1 to {count}, "
                                "each once")
        poses[number] = _matrix(path, lines[first + 1:first + 5], 4)
    return poses
