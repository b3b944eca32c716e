"""The attributes of a frame's file that programs know by name: the camera, the rate and the time code.

Source: "Standard Attributes" of the OpenEXR documentation; SMPTE ST 12-1 (time codes).
"""

from fractions import Fraction
from typing import Any

import numpy as np
import OpenEXR

from stage.capture.camera import Camera
from stage.results.result_metadata import CAMERA

FRAMES_PER_SECOND = 24.0
"""The rate of frames where neither the request nor its light keys say one: that of film."""
NTSC = Fraction(1000, 1001)
"""The rates of NTSC video are the whole ones times this."""
SAME_RATE = 0.005
"""Rates that differ by less are one rate: 23.976, 23.98 and 24000/1001 frames per second."""
FASTEST_TIMECODE = 30
"""The most frames in a second that a time code counts."""
SQUARE = 0.01
"""Pixels count as square up to this difference of the focal lengths, which is more than calibrations are wrong by."""
TO_LEFT_HANDED = np.diag([1.0, 1.0, -1.0, 1.0])
"""Transform from Relit's camera frame, which looks along −z, to that of OpenEXR, which looks along +z."""


def camera_attributes(camera: Camera) -> dict[str, Any]:
    """Return the attributes of the camera: its matrices, the screen window of a perspective, and `relit:camera`.

    Convention: the matrices apply to row vectors; lens distortion is in `relit:camera` alone.
    """
    camera_from_world = np.linalg.inv(camera.pose)
    found: dict[str, Any] = {
        CAMERA: camera.model_dump_json(),
        "worldToCamera": _rows(TO_LEFT_HANDED @ camera_from_world),
        "worldToNDC": _rows(_ndc_from_camera(camera) @ camera_from_world),
    }
    if camera.focal_px is not None:
        focal_x, focal_y = camera.focal_px
        cu, cv = camera.principal_point
        found["screenWindowWidth"] = float(camera.width / focal_x)
        found["screenWindowCenter"] = np.array([(camera.width / 2 - cu) / focal_x, (cv - camera.height / 2) / focal_y], dtype=np.float32)
        if abs(focal_y / focal_x - 1) > SQUARE:
            found["pixelAspectRatio"] = float(focal_y / focal_x)
    return found


def time_attributes(number: int, rate: float) -> dict[str, Any]:
    """Return the rate, frames per second, as a fraction, and the time code of a frame.

    Frame 0 is at 00:00:00:00, and after 24 hours the time code begins again. A rate above 30 has no time code, and neither has one that
    is not whole, or whole times 1000/1001.
    """
    exact = exact_rate(rate)
    found: dict[str, Any] = {"framesPerSecond": exact}
    whole = round(exact)
    if exact <= FASTEST_TIMECODE and exact in (whole, whole * NTSC):
        seconds, frame = divmod(number, whole)
        code = OpenEXR.TimeCode()
        code.frame, code.seconds, code.minutes, code.hours = frame, seconds % 60, seconds // 60 % 60, seconds // 3600 % 24
        found["timeCode"] = code
    return found


def exact_rate(rate: float) -> Fraction:
    """Return the fraction that a rate in frames per second stands for: 24000/1001 for 23.976, 25 for 25."""
    whole = max(round(rate), 1)
    for candidate in (Fraction(whole), whole * NTSC):
        if abs(float(candidate) - rate) < SAME_RATE:
            return candidate
    return Fraction(rate).limit_denominator(1001)


def _ndc_from_camera(camera: Camera) -> np.ndarray:
    """Return the 4 × 4 matrix from the camera frame to the image, (0, 0) its upper left corner and (1, 1) its lower right one.

    The third coordinate, which the definition leaves open, is 1 / depth for a perspective and z for an orthographic camera.
    """
    cu, cv = camera.principal_point
    u, v = cu / camera.width, cv / camera.height
    if camera.focal_px is not None:
        x, y = camera.focal_px[0] / camera.width, camera.focal_px[1] / camera.height
        return np.array([[x, 0, -u, 0], [0, -y, -v, 0], [0, 0, 0, 1], [0, 0, -1, 0]], dtype=np.float64)
    pixel = camera.pixel_size_m or 1.0
    x, y = 1 / (pixel * camera.width), 1 / (pixel * camera.height)
    return np.array([[x, 0, 0, u], [0, -y, 0, v], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)


def _rows(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix for column vectors as one for row vectors, float32."""
    return np.ascontiguousarray(matrix.T, dtype=np.float32)
