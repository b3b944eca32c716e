"""Calibrations of a camera and a projector in OpenCV files, SLStudio's among them, as entries of a manifest.

An OpenCV calibration has pixel centres at whole numbers, so cx and cy become 0.5 larger. Its axes are x right, y down, z forward,
and R, T take points from the camera to the projector (stereoCalibrate with the camera first).
"""

from pathlib import Path
from typing import Any

from stage.calibration.opencv_file import camera_from_projector, lens, pick, read_matrices
from stage.camera import Distortion
from stage.errors import ManifestError

CAMERA_MATRIX = ("cam_K", "cam_int", "camera_matrix", "cameraMatrix1", "M1", "K1", "mtx1", "Kc")
CAMERA_LENS = ("cam_kc", "cam_dist", "distortion_coefficients", "distCoeffs1", "D1", "dist1", "kc")
PROJECTOR_MATRIX = ("proj_K", "proj_int", "projector_matrix", "cameraMatrix2", "M2", "K2", "mtx2", "Kp")
PROJECTOR_LENS = ("proj_kc", "proj_dist", "projector_distortion", "distCoeffs2", "D2", "dist2", "kp")
ROTATION, TRANSLATION = ("R", "rotation", "roatation", "Rp"), ("T", "translation", "t", "Tp")
"""The names under which calibration files hold these matrices and vectors, in order of preference; one common tool misspells, and those
with a small p or c at the end are SLStudio's."""
CAMERA_SIZE, PROJECTOR_SIZE = ("frameWidth", "frameHeight"), ("screenResX", "screenResY")
"""The names of the image sizes in SLStudio's files."""
PIXEL_CENTRE = 0.5
"""The image coordinate of the centre of the first pixel, which is 0 in OpenCV."""


def camera_and_projector(path: Path, resolution: tuple[int, int], projector: tuple[int, int], unit_m: float) -> dict[str, Any]:
    """Return the camera and the projector of the manifest from an OpenCV calibration file.

    Raises:
        ManifestError: a matrix is missing or invalid, or the file is of images of another size.
    """
    found = read_matrices(path)
    rotation = pick(found, ROTATION, path, "rotation R", shape=(3, 3))
    translation = pick(found, TRANSLATION, path, "translation T", shape=(3,)) * unit_m
    pose = camera_from_projector(rotation, translation)
    entries = {}
    for what, matrix, coefficients, sides, size in (
            ("camera", CAMERA_MATRIX, CAMERA_LENS, CAMERA_SIZE, resolution),
            ("projector", PROJECTOR_MATRIX, PROJECTOR_LENS, PROJECTOR_SIZE, projector)):
        given = _size(found, sides)
        if given is not None and given != tuple(size):
            raise ManifestError(f"{path}: is of a {what} of {given[0]}x{given[1]} px, this one has {size[0]}x{size[1]}")
        k = pick(found, matrix, path, f"matrix of the {what}", shape=(3, 3))
        known = any(name in found for name in coefficients)
        glass = lens(pick(found, coefficients, path, "distortion"), path, what) if known else Distortion(model="brown_conrady")
        entries[what] = {"resolution": list(size), "focal_px": [k[0, 0], k[1, 1]],
                         "principal_px": [k[0, 2] + PIXEL_CENTRE, k[1, 2] + PIXEL_CENTRE], "distortion": glass.model_dump()}
    return {"camera": {"projection": "perspective", **entries["camera"]},
            "projector": {**entries["projector"], "camera_from_projector": pose.tolist()}}


def projector_size(path: Path) -> tuple[int, int] | None:
    """Return the width and height of the projector in a calibration file; None where it does not say them.

    Raises:
        ManifestError: the file cannot be parsed.
        StorageError: the file cannot be read.
    """
    return _size(read_matrices(path), PROJECTOR_SIZE)


def _size(found: dict[str, Any], names: tuple[str, str]) -> tuple[int, int] | None:
    sides = [found[name] for name in names if name in found and found[name].size == 1]
    if len(sides) < 2 or not all(float(side.item()).is_integer() and side.item() > 0 for side in sides):
        return None
    return int(sides[0].item()), int(sides[1].item())
