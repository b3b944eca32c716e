"""The capturing camera of an asset: where it stands, between which distances it sees, and the length of a unit of the surface."""

from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera

ORTHOGRAPHIC_CLEARANCE = 0.5
"""Distance of an orthographic camera from the surface, in image widths; its image does not depend on it."""


class View(NamedTuple):
    """The place of a camera that looks along -z, in units of the height map."""

    z: float  # camera-frame z
    near: float  # distance of the near clipping plane
    far: float  # distance of the far one


def view_of(camera: Camera, extent: np.ndarray) -> View:
    """Return where the camera stands, and a clipping range twice as deep as the surface's bounding box [2, 3], camera frame."""
    farthest, nearest = float(extent[0, 2]), float(extent[1, 2])
    if camera.projection == "perspective":
        return View(0.0, -nearest / 2, -farthest * 2)
    clearance = ORTHOGRAPHIC_CLEARANCE * camera.width * (camera.pixel_size_m or 1.0)
    return View(nearest + clearance, clearance / 2, 2 * (clearance + nearest - farthest))


UNIT_WITHOUT_SCALE_M = 0.001
"""Metres of a pixel where the capture has no scale, so that the asset has a visible size."""

SCALE_NOTE = "unknown: the capture gives no scale, so one pixel is taken as one millimetre"


def unit_in_metres(camera: Camera) -> float:
    """Return the metres of a unit of the height map: 1, or that of a pixel where the capture has no scale."""
    return 1.0 if camera.metric else UNIT_WITHOUT_SCALE_M
