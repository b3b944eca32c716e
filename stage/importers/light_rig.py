"""Rigs of near lights: positions, directions, strengths and anisotropy of LEDs in .mat and JSON files, and camera matrices.

The names S, Dir, Phi, mu and K are those of Quéau, Durix, Wu, Cremers, Lauze and Durou, "LED-Based Photometric Stereo: Modeling,
Calibration and Numerical Solution", JMIV 2018, and of its program near_ps, whose file is `light.mat`.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stage.capture.camera import Distortion
from stage.errors import ManifestError
from stage.formats.mat_file import read_mat_arrays
from stage.importers.layout import first_of, read_json
from stage.importers.opencv_file import CAMERA_SIZE, check_size, lens, read_matrices

POSITIONS = ("s", "positions", "position", "locations", "pos")
AXES = ("dir", "directions", "direction", "orientations", "orientation", "axes", "axis", "ns")
STRENGTHS = ("phi", "intensities", "intensity", "strengths", "rgb")
ANISOTROPY = ("mu", "anisotropy")
IMAGES = ("image", "file", "filename", "name")
"""Names of variables and keys in small letters, in order of preference; the last part of names such as calib.S counts."""
CAMERA_MATRIX = ("K", "camera_matrix", "cameraMatrix", "mtx", "cam_K", "Kc", "M1", "K1", "cameraMatrix1")
CAMERA_LENS = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "dist", "cam_kc", "kc", "D1", "distCoeffs1")
MATLAB_CENTRE, OPENCV_CENTRE = -0.5, 0.5
"""Offsets that are added to image coordinates of MATLAB, where the centre of the first pixel is 1, and of OpenCV, where it is 0."""


class LightRig(NamedTuple):
    """The lights of a rig, in its own axes and unit."""

    positions: np.ndarray  # [lights, 3] float64
    axes: np.ndarray | None  # [lights, 3] float64
    strengths: np.ndarray | None  # [lights, 3] float64
    anisotropy: np.ndarray | None  # [lights] float64
    names: tuple[str, ...] | None
    """The image of each light, where the file names them."""


class CameraMatrix(NamedTuple):
    """The intrinsics in a file."""

    focal_px: tuple[float, float]
    principal_px: tuple[float, float]
    """Image coordinates of the manifest, where the centre of the first pixel is 0.5, 0.5."""
    distortion: Distortion | None
    convention: str
    """Words for the place of the first pixel's centre in the file."""


def read_rig(path: Path) -> LightRig:
    """Read the lights of a rig.
    `path`: a .mat file with S (positions) and, if they are known, Dir, Phi and mu; or a .json file with these keys, with `positions`,
    `directions`, `intensities` and `mu`, or with a list `lights` of objects of `position`, `direction`, `intensity`, `mu` and `image`."""
    if path.suffix.lower() == ".mat":
        fields: dict[str, Any] = {name.rpartition(".")[2].lower(): value for name, value in read_mat_arrays(path).items()}
    else:
        fields = _from_json(path)
    positions = _pick(path, fields, POSITIONS, 3)
    if positions is None:
        raise ManifestError(f"{path}: holds {', '.join(fields) or 'no array'}: there must be positions of the lights, S or positions")
    count = len(positions)
    axes, strengths = _pick(path, fields, AXES, 3, count), _pick(path, fields, STRENGTHS, None, count)
    mu = _pick(path, fields, ANISOTROPY, 1, count)
    if mu is not None and (mu < 0).any():
        raise ManifestError(f"{path}: mu of light {int(np.argmax(mu[:, 0] < 0)) + 1} is negative")
    if mu is not None and (mu > 0).any() and axes is None:
        raise ManifestError(f"{path}: mu is above 0, but there are no directions of the lights (Dir): mu needs them")
    names = fields.get("image")
    return LightRig(positions, axes, None if strengths is None else np.broadcast_to(strengths, (count, 3)).copy(),
                    None if mu is None else mu[:, 0], names if isinstance(names, tuple) else None)


def read_camera_matrix(path: Path, resolution: tuple[int, int]) -> CameraMatrix:
    """Read the intrinsics of a camera from a .mat file of MATLAB (K, or its transpose) or from an OpenCV file (.yml, .xml, .json).
    `resolution`: the width and height of its images."""
    matlab = path.suffix.lower() == ".mat"
    matrices = read_mat_arrays(path) if matlab else read_matrices(path)
    name = next((name for name in CAMERA_MATRIX if name in matrices), None)
    if name is None or matrices[name].shape != (3, 3) or not np.isfinite(matrices[name]).all():
        raise ManifestError(f"{path}: holds {', '.join(matrices) or 'nothing'}: there must be the 3 x 3 matrix of the camera, as K or "
                            "camera_matrix")
    k = np.asarray(matrices[name], dtype=np.float64)
    k = k.T if k[0, 2] == 0 and k[2, 0] != 0 else k  # MATLAB's toolboxes write the transpose
    if k[0, 0] <= 0 or k[1, 1] <= 0:
        raise ManifestError(f"{path}: {name}: its focal lengths are {k[0, 0]:g} and {k[1, 1]:g}: they must be above 0")
    shift = MATLAB_CENTRE if matlab else OPENCV_CENTRE
    coefficients = first_of(matrices, CAMERA_LENS)
    glass = None if coefficients is None or not np.any(coefficients) else lens(coefficients, path, "camera")
    principal = (float(k[0, 2]) + shift, float(k[1, 2]) + shift)
    width, height = resolution
    check_size(path, "camera", matrices, CAMERA_SIZE, resolution)
    if not (0 <= principal[0] <= width and 0 <= principal[1] <= height):
        raise ManifestError(f"{path}: its principal point is {principal[0]:g}, {principal[1]:g}, outside the images of {width}x{height} "
                            "pixels: it belongs to another resolution")
    return CameraMatrix((float(k[0, 0]), float(k[1, 1])), principal, glass, "1, 1 (MATLAB)" if matlab else "0, 0 (OpenCV)")


def _from_json(path: Path) -> dict[str, Any]:
    data = read_json(path)
    if isinstance(data, dict) and isinstance(data.get("lights"), list):
        data = data["lights"]
    if isinstance(data, list):
        if not data or not all(isinstance(light, dict) for light in data):
            raise ManifestError(f"{path}: must hold a list of objects with position, direction, intensity and mu")
        lights = [{str(key).lower(): value for key, value in light.items()} for light in data]
        keys = set(lights[0])
        for index, light in enumerate(lights):
            if set(light) != keys:
                raise ManifestError(f"{path}: light {index + 1} has the keys {', '.join(sorted(light))}, "
                                    f"the first {', '.join(sorted(keys))}")
        data = {key: [light[key] for light in lights] for key in lights[0]}
        for key in IMAGES:
            if key in data:
                data["image"] = tuple(map(str, data.pop(key)))
    if not isinstance(data, dict):
        raise ManifestError(f"{path}: must hold an object with positions, directions, intensities and mu")
    return {str(key).lower(): value for key, value in data.items()}


def _pick(path: Path, fields: dict[str, Any], names: tuple[str, ...], width: int | None, count: int | None = None) -> np.ndarray | None:
    """Return the array under the first of several names as [lights, numbers], or None; `width` None allows one number or three."""
    name = next((name for name in names if name in fields), None)
    if name is None:
        return None
    try:
        values = np.asarray(fields[name], dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise ManifestError(f"{path}: {name}: must be numbers, equally many for each light") from error
    values = values.reshape(-1, 1) if values.ndim == 1 or 1 in values.shape else values
    widths = (1, 3) if width is None else (width,)
    if values.ndim == 2 and values.shape[1] not in widths and values.shape[0] in widths and count in (None, values.shape[1]):
        values = values.T
    if values.ndim != 2 or values.shape[1] not in widths or count not in (None, len(values)) or not np.isfinite(values).all():
        wanted = f"{count if count is not None else 'n'} x {' or '.join(map(str, widths))}"
        raise ManifestError(f"{path}: {name}: is {' x '.join(map(str, values.shape))}, must be {wanted} finite numbers")
    return values
