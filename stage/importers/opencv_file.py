"""Reading of OpenCV calibration files (YAML, XML and JSON of cv2.FileStorage, and JSON with plain lists), and their conventions."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stage.capture.camera import Distortion
from stage.errors import ManifestError
from stage.importers.layout import read_text
from stage.transforms import OPENCV_FROM_CAMERA

SUFFIXES = (".yml", ".yaml", ".xml", ".json")
CAMERA_SIZE = (("image_width", "image_height"), ("frameWidth", "frameHeight"))
"""The names of the image size of a camera in OpenCV's files and in SLStudio's."""
COEFFICIENTS = 5
"""The count of Brown-Conrady coefficients, k1 k2 p1 p2 k3; a capture cannot hold the rational, thin prism and tilt terms."""


def read_matrices(path: Path) -> dict[str, np.ndarray]:
    """Read every matrix and number of a file. Returns the float64 arrays, of one or two dimensions, by their names."""
    if path.suffix.lower() not in SUFFIXES:
        raise ManifestError(f"{path}: is no OpenCV calibration: its suffix must be one of {', '.join(SUFFIXES)}")
    text = read_text(path)
    if path.suffix.lower() == ".json":
        return _from_json(path, text)
    try:
        file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = file.root()
        found = {}
        for name in root.keys():  # noqa: SIM118 - a FileNode, not a mapping
            node = root.getNode(name)
            if node.isMap() and node.getNode("dt").empty():  # as ROS writes the calibration of a camera
                rows, cols, data = (node.getNode(part) for part in ("rows", "cols", "data"))
                found[name] = np.array([data.at(i).real() for i in range(data.size())]).reshape(int(rows.real()), int(cols.real()))
            elif node.isMap():
                found[name] = np.asarray(node.mat(), dtype=np.float64)
            elif node.isReal() or node.isInt():
                found[name] = np.array([node.real()])
            elif node.isSeq():
                values = [node.at(i).real() for i in range(node.size()) if node.at(i).isReal() or node.at(i).isInt()]
                if len(values) == node.size():
                    found[name] = np.array(values, dtype=np.float64)
        file.release()
    except (cv2.error, SystemError, ValueError, TypeError) as error:
        raise ManifestError(f"{path}: cannot be read as an OpenCV file") from error
    return found


def _from_json(path: Path, text: str) -> dict[str, np.ndarray]:
    try:
        data = json.loads(text)
    except RecursionError as error:
        raise ManifestError(f"{path}: is nested too deeply") from error
    except ValueError as error:
        raise ManifestError(f"{path}: is not JSON") from error
    if not isinstance(data, dict):
        raise ManifestError(f"{path}: must hold one JSON object")
    found = {}
    for name, value in data.items():
        array = _matrix(value)
        if array is not None:
            found[name] = array
    return found


def _matrix(value: Any) -> np.ndarray | None:
    """Return a JSON value as an array, or None when it is no matrix."""
    try:
        if isinstance(value, dict):
            return np.array(value["data"], dtype=np.float64).reshape(int(value["rows"]), int(value["cols"]))
        return np.atleast_1d(np.array(value, dtype=np.float64))
    except (KeyError, ValueError, TypeError, OverflowError):
        return None


def pick(matrices: Mapping[str, np.ndarray], names: tuple[str, ...], path: Path, what: str, *,
         shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Return the matrix that a file holds under the first of several names.
    `shape`: the shape that the matrix must have; None allows any."""
    name = next((name for name in names if name in matrices), None)
    if name is None:
        raise ManifestError(f"{path}: holds no {what}: give it as one of {', '.join(names)}")
    found = matrices[name]
    if not np.isfinite(found).all() or (shape is not None and found.size != int(np.prod(shape))):
        raise ManifestError(f"{path}: {name}: must be {' x '.join(map(str, shape or ('finite',)))} numbers")
    return found.reshape(shape) if shape is not None else found


def check_size(path: Path, what: str, matrices: Mapping[str, np.ndarray], names: tuple[tuple[str, str], ...],
               resolution: tuple[int, int]) -> None:
    """Raise ManifestError if a file says that a calibration is of images of another size.
    `names`: the names of a width and a height, of which a file holds one pair or none."""
    for pair in names:
        given = told_size(matrices, pair)
        if given is not None and given != tuple(resolution):
            raise ManifestError("{}: is of a {} of {}x{} px, this one has {}x{}".format(path, what, *given, *resolution))


def told_size(matrices: Mapping[str, np.ndarray], names: tuple[str, str]) -> tuple[int, int] | None:
    """Return the width and height that a file has under these names, or None."""
    sides = [matrices[name] for name in names if name in matrices and matrices[name].size == 1]
    if len(sides) < 2 or not all(float(side.item()).is_integer() and side.item() > 0 for side in sides):
        return None
    return int(sides[0].item()), int(sides[1].item())


def lens(coefficients: np.ndarray, path: Path, what: str) -> Distortion:
    """Return the distortion of a manifest from OpenCV's vector k1 k2 p1 p2 [k3 …]."""
    values = np.asarray(coefficients, dtype=np.float64).ravel()
    if len(values) < 4 or not np.isfinite(values).all() or np.any(values[COEFFICIENTS:]):
        raise ManifestError(f"{path}: the distortion of the {what} must be k1 k2 p1 p2 and, if any, k3; other models are not known")
    return distortion_of(values)


def distortion_of(coefficients: np.ndarray) -> Distortion:
    """Return the distortion of a manifest from the first of OpenCV's coefficients k1 k2 p1 p2 k3, the last of which may be missing."""
    k1, k2, p1, p2, k3 = (float(value) for value in np.append(coefficients.ravel(), 0.0)[:COEFFICIENTS])
    return Distortion(model="brown_conrady", k=(k1, k2, k3), p=(p1, p2))


def camera_from_projector(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the pose of a projector in a manifest from the result of OpenCV's stereoCalibrate with the camera first.
    `rotation`: [3, 3] R, from the camera to the projector on OpenCV's axes. `translation`: [3] T, metres. Returns [4, 4] float64
    `camera_from_projector`, metres, camera frames."""
    pose = np.eye(4)
    pose[:3, :3] = OPENCV_FROM_CAMERA @ rotation.T @ OPENCV_FROM_CAMERA
    pose[:3, 3] = OPENCV_FROM_CAMERA @ (-rotation.T @ translation)
    return pose
