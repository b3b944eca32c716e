"""The light that may reach an object from what lies beyond the image.

A surface that goes on beyond the border of the image throws light on what the image shows, and nothing says how much. What the mirror image
of the surface at the border would throw is a measure of it.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from service.solve.height.height import projection_of
from service.solve.height.interreflection import Patches
from stage.capture.camera import Camera


class Border(NamedTuple):
    """One of the four borders of an image."""

    axis: int
    """0 for the top and bottom borders, which rows cross, 1 for the left and right ones."""
    last: bool
    """Whether it is that of the last row or column."""

    def mirror(self, camera: Camera) -> "Mirror":
        """Return the plane of the lines of sight at the border."""
        at = np.array([camera.width / 2, camera.height / 2])
        at[1 - self.axis] *= 2 * self.last
        x, y = (float(part[0]) for part in camera.plane_at(*at[:, None]))
        perspective = camera.projection == "perspective"
        across = np.cross([x, y, -1.0] if perspective else [0.0, 0.0, 1.0], [0.0, 1.0, 0.0] if self.axis else [1.0, 0.0, 0.0])
        across = across / np.linalg.norm(across)
        return Mirror(across, 0.0 if perspective else float(across @ [x, y, 0.0]))


class Mirror(NamedTuple):
    """A plane that mirrors."""

    across: np.ndarray  # [3] its unit normal
    offset: float  # its distance from the camera frame's origin along that

    def turned(self, vectors: np.ndarray) -> np.ndarray:
        """Return the mirror images of directions [..., 3]."""
        return vectors - 2 * (vectors @ self.across)[..., None] * self.across

    def mirrored(self, points: np.ndarray) -> np.ndarray:
        """Return the mirror images of camera-frame points [..., 3]."""
        return points - 2 * (points @ self.across - self.offset)[..., None] * self.across


def light_from_beyond(patches: Patches, camera: Camera, directions: np.ndarray, height: wp.array, solved: np.ndarray) -> np.ndarray | None:
    """Return the light that mirror images of a surface beyond the borders that it reaches would throw on each patch of it,
    [patches, 3, lights] as of `ArrivingLight`, or None where it reaches no border.
    `directions`: [lights, 3] to the lights. `height`: [rows, cols] float32 on the device. `solved`: [rows, cols] bool, the surface.

    A mirror image under a light looks as the surface does under the mirrored light, or the one next to that."""
    borders = [border for border in (Border(axis, last) for axis in (0, 1) for last in (False, True))
               if np.take(solved, -border.last, border.axis).any()]
    if not borders:
        return None
    light = np.zeros_like(patches.radiance)
    for border in borders:
        along = np.take(solved, -border.last, border.axis)  # where the surface reaches it, by pixel
        reached = np.logical_or.reduceat(along, np.arange(0, len(along), patches.side))
        some = reached[patches.cells[:, 1 - border.axis]]
        if not some.any():  # too little of a patch reaches it
            continue
        mirror = border.mirror(camera)
        seen = (directions @ mirror.turned(directions).T).argmax(axis=0)
        mirrored = patches._replace(
            centres=mirror.mirrored(patches.centres[some]), facing=mirror.turned(patches.facing[some]),
            areas=patches.areas[some], cells=patches.cells[some], radiance=patches.radiance[some][:, :, seen])
        light += mirrored.light_on(patches, height, projection_of(camera))
    return light
