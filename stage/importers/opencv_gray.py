"""Images in the order of OpenCV's GrayCodePattern, with an optional OpenCV calibration file.

The order: every bit of the columns, coarsest first, each followed by its inverse; the rows in the same way; then white and black.
An OpenCV calibration counts pixel centres as whole numbers, so cx and cy become 0.5 larger; its frame is x right, y down, z forward,
and R, T take points from the camera's to the projector's (stereoCalibrate with the camera first).
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from stage.calibration.opencv_file import lens, pick, read_matrices
from stage.camera import Distortion
from stage.errors import ManifestError, storage
from stage.images import SUFFIXES
from stage.importers.layout import finish, image_resolution
from stage.manifest import SCHEMA

CAMERA_MATRIX = ("cam_K", "cam_int", "camera_matrix", "cameraMatrix1", "M1", "K1", "mtx1")
CAMERA_LENS = ("cam_kc", "cam_dist", "distortion_coefficients", "distCoeffs1", "D1", "dist1")
PROJECTOR_MATRIX = ("proj_K", "proj_int", "projector_matrix", "cameraMatrix2", "M2", "K2", "mtx2")
PROJECTOR_LENS = ("proj_kc", "proj_dist", "projector_distortion", "distCoeffs2", "D2", "dist2")
ROTATION, TRANSLATION = ("R", "rotation", "roatation"), ("T", "translation", "t")
PIXEL_CENTRE = 0.5
"""What OpenCV's coordinates lack to ours."""
FLIP = np.diag([1.0, -1.0, -1.0])
"""Between x right, y down, z forward and x right, y up, z backward; its own inverse."""


def import_folder(source: Path, destination: Path, *, projector: tuple[int, int], calibration: Path | None = None,
                  unit_m: float = 1.0) -> Path:
    """Write a capture.json for a Gray-code scan.

    Args:
        source: folder with the images, taken in the natural order of their names: 2 before 10.
        destination: the capture's folder; the same, or another, which gets links to (or copies of) the images.
        projector: its width and height in pixels, which say how many bits there are.
        calibration: OpenCV file with the intrinsics of both, R and T; None: `relit calibrate procam` finds them.
        unit_m: metres of one unit of T.

    Returns:
        The path of the manifest.

    Raises:
        ManifestError: another count of images than the projector needs, or a calibration that lacks something.
    """
    names = _images(source)
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
        data |= devices(calibration, resolution, projector, unit_m)
    data["frames"] = [{"image": name, "pattern": pattern} for name, pattern in zip(names, patterns, strict=True)]
    return finish(data, source / names[0], destination)


def gray_order(width: int, height: int) -> list[dict[str, Any]]:
    """The manifest entries of OpenCV's images, in order."""
    entries: list[dict[str, Any]] = []
    for axis, size in (("column", width), ("row", height)):
        bits = max(1, (size - 1).bit_length())
        entries += [{"code": "gray", "axis": axis, "bit": bit, "bits": bits, "inverse": inverse}
                    for bit in reversed(range(bits)) for inverse in (False, True)]
    return [*entries, {"code": "white"}, {"code": "black"}]


def devices(path: Path, resolution: tuple[int, int], projector: tuple[int, int], unit_m: float) -> dict[str, Any]:
    """The manifest's camera and projector from an OpenCV file.

    Raises:
        ManifestError: something is missing or cannot be.
    """
    found = read_matrices(path)
    turn = pick(found, ROTATION, path, "rotation R", shape=(3, 3))
    shift = pick(found, TRANSLATION, path, "translation T", shape=(3,)) * unit_m
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = FLIP @ turn.T @ FLIP, FLIP @ (-turn.T @ shift)
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


def _images(source: Path) -> list[str]:
    with storage("read", source):
        names = [path.name for path in source.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
    return sorted(names, key=lambda name: [int(part) if part.isdecimal() else part.lower() for part in re.split(r"(\d+)", name)])
