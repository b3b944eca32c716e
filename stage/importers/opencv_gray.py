"""Import of images in the order of OpenCV's GrayCodePattern, with an optional OpenCV calibration file.

The order is every bit of the columns, coarsest first, each followed by its inverse; the rows in the same way; then white and black.
An OpenCV calibration has pixel centres at whole numbers, so cx and cy become 0.5 larger. Its axes are x right, y down, z forward,
and R, T take points from the camera to the projector (stereoCalibrate with the camera first).
"""

from pathlib import Path
from typing import Any

from stage.calibration.opencv_file import camera_from_projector, lens, pick, read_matrices
from stage.camera import Distortion
from stage.errors import ManifestError
from stage.importers.layout import image_names, image_resolution, write_capture
from stage.manifest import SCHEMA

CAMERA_MATRIX = ("cam_K", "cam_int", "camera_matrix", "cameraMatrix1", "M1", "K1", "mtx1")
CAMERA_LENS = ("cam_kc", "cam_dist", "distortion_coefficients", "distCoeffs1", "D1", "dist1")
PROJECTOR_MATRIX = ("proj_K", "proj_int", "projector_matrix", "cameraMatrix2", "M2", "K2", "mtx2")
PROJECTOR_LENS = ("proj_kc", "proj_dist", "projector_distortion", "distCoeffs2", "D2", "dist2")
ROTATION, TRANSLATION = ("R", "rotation", "roatation"), ("T", "translation", "t")
"""The names under which calibration files hold these matrices and vectors, in order of preference; one common tool misspells."""
PIXEL_CENTRE = 0.5
"""The image coordinate of the centre of the first pixel, which is 0 in OpenCV."""


def import_folder(source: Path, destination: Path, *, projector: tuple[int, int], calibration: Path | None = None,
                  unit_m: float = 1.0) -> Path:
    """Write a capture.json for a Gray-code scan.

    Args:
        source: the folder of the images, which are taken in the natural order of their names: 2 before 10.
        destination: the folder of the capture; another folder than `source` gets links to, or copies of, the images.
        projector: the width and height of the projector in pixels, which determine the count of bits.
        calibration: an OpenCV file with the intrinsics of camera and projector, R and T; None leaves them to `relit calibrate procam`.
        unit_m: the metres in one unit of T.

    Returns:
        The path of the manifest.

    Raises:
        ManifestError: the count of images does not fit the projector, or the calibration file lacks a matrix.
    """
    names = image_names(source)
    patterns = gray_order(*projector)
    if len(names) != len(patterns):
        raise ManifestError(f"{source}: holds {len(names)} images, a projector of {projector[0]}x{projector[1]} px takes {len(patterns)}: "
                            "columns and rows with inverses, white, black")
    resolution = image_resolution(source / names[0])
    data: dict[str, Any] = {
        "schema": SCHEMA, "name": source.resolve().name,
        "color_space": "lin_rec709_scene",
        "camera": {"projection": "orthographic", "resolution": resolution},
    }
    if calibration is not None:
        data |= camera_and_projector(calibration, resolution, projector, unit_m)
    data["frames"] = [{"image": name, "pattern": pattern} for name, pattern in zip(names, patterns, strict=True)]
    return write_capture(data, source / names[0], destination)


def gray_order(width: int, height: int) -> list[dict[str, Any]]:
    """Return the manifest entries of the patterns in the order of OpenCV's images."""
    entries: list[dict[str, Any]] = []
    for axis, size in (("column", width), ("row", height)):
        bits = max(1, (size - 1).bit_length())
        entries += [{"code": "gray", "axis": axis, "bit": bit, "bits": bits, "inverse": inverse}
                    for bit in reversed(range(bits)) for inverse in (False, True)]
    return [*entries, {"code": "white"}, {"code": "black"}]


def camera_and_projector(path: Path, resolution: tuple[int, int], projector: tuple[int, int], unit_m: float) -> dict[str, Any]:
    """Return the camera and the projector of the manifest from an OpenCV calibration file.

    Raises:
        ManifestError: a matrix is missing or invalid.
    """
    found = read_matrices(path)
    rotation = pick(found, ROTATION, path, "rotation R", shape=(3, 3))
    translation = pick(found, TRANSLATION, path, "translation T", shape=(3,)) * unit_m
    pose = camera_from_projector(rotation, translation)
    entries = {}
    for what, matrix, coefficients, size in (("camera", CAMERA_MATRIX, CAMERA_LENS, resolution),
                                             ("projector", PROJECTOR_MATRIX, PROJECTOR_LENS, projector)):
        k = pick(found, matrix, path, f"matrix of the {what}", shape=(3, 3))
        known = any(name in found for name in coefficients)
        glass = lens(pick(found, coefficients, path, "distortion"), path, what) if known else Distortion(model="brown_conrady")
        entries[what] = {"resolution": list(size), "focal_px": [k[0, 0], k[1, 1]],
                         "principal_px": [k[0, 2] + PIXEL_CENTRE, k[1, 2] + PIXEL_CENTRE], "distortion": glass.model_dump()}
    return {"camera": {"projection": "perspective", **entries["camera"]},
            "projector": {**entries["projector"], "camera_from_projector": pose.tolist()}}
