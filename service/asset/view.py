"""Where the capturing camera of an asset stands, and between which distances it sees."""

from typing import NamedTuple

import numpy as np

from stage.camera import Camera

ORTHOGRAPHIC_CLEARANCE = 0.5
"""Distance of an orthographic camera from the surface, in image widths; its image does not depend on it."""


class View(NamedTuple):
    """The place of a camera that looks along -z, in units of the height map."""

    z: float  # camera-frame z
    near: float  # distance of the near clipping plane
    far: float  # distance of the far one


def view_of(camera: Camera, extent: np.ndarray) -> View:
    """Return where the camera stands, and a clipping range twice as deep as the surface.

    Args:
        extent: [2, 3] bounding box of the surface, camera frame.
    """
    farthest, nearest = float(extent[0, 2]), float(extent[1, 2])
    if camera.projection == "perspective":
        return View(0.0, -nearest / 2, -farthest * 2)
    clearance = ORTHOGRAPHIC_CLEARANCE * camera.width * (camera.pixel_size_m or 1.0)
    return View(nearest + clearance, clearance / 2, 2 * (clearance + nearest - farthest))
