"""The light that may reach an object from what lies beyond the image.

A surface that goes on beyond the border of the image throws light on what the image shows, and nothing says how much. It may end there; it
may go on as its mirror image at the border, whose slopes are the opposite ones; or as itself turned by half a turn about the border, whose
slopes are the same. A mirror image lights a valley that the border cuts, and a surface that keeps its slopes a wall across from it.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from service.solve.height.height import projection_of
from service.solve.height.interreflection import Patches
from stage.capture.camera import Camera

MIRRORED, TURNED = 1, 2
"""Numbers of the ways in which a surface goes on beyond a border; 0: it ends there."""
LIKELY = np.array([0.4, 0.1, 0.5])
"""Likelihood of each of these before the readings are asked. Near a border slopes are kept, and mirror images bend what is round."""


class Border(NamedTuple):
    """One of the four borders of an image."""

    axis: int
    """0 for the top and bottom borders, which rows cross, 1 for the left and right ones."""
    last: bool
    """Whether it is that of the last row or column."""

    def mirrored(self, patches: Patches, camera: Camera, directions: np.ndarray) -> Patches:
        """Return the mirror image of a surface at the border. `directions`: [lights, 3] to the lights."""
        mirror = self.mirror(camera)
        seen = (directions @ mirror.turned(directions).T).argmax(axis=0)
        return patches._replace(centres=mirror.mirrored(patches.centres), facing=mirror.turned(patches.facing),
                                radiance=patches.radiance[:, :, seen])

    def turned(self, patches: Patches) -> Patches:
        """Return a surface that goes on with the slopes it has: each row or column of patches that crosses the border is turned by half a
        turn about the point where it does. Centres are NaN where none does."""
        grid = np.moveaxis(patches.numbers, self.axis, 0)[:: -1 if self.last else 1]
        outer, inner = grid[0], grid[min(1, len(grid) - 1)]
        at = np.where((outer >= 0)[:, None], patches.centres[outer], np.nan)
        at = np.where((inner >= 0)[:, None], 1.5 * at - 0.5 * patches.centres[inner], at)
        return patches._replace(centres=2 * at[patches.cells[:, 1 - self.axis]] - patches.centres)

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
    """Return the light that a surface would throw on each patch of itself from beyond the borders that it reaches, [3, patches, 3, lights]
    as of `ArrivingLight`: were it to end there, to go on as its mirror image, and as itself turned about the border. None where it reaches
    no border. `directions`: [lights, 3] to the lights. `height`: [rows, cols] float32 on the device. `solved`: [rows, cols] bool, the
    surface.

    A mirror image under a light looks as the surface does under the mirrored light, or the one next to that; what keeps its slopes looks
    as it does."""
    borders = [border for border in (Border(axis, last) for axis in (0, 1) for last in (False, True))
               if np.take(solved, -border.last, border.axis).any()]
    if not borders:
        return None
    light = np.zeros((3, *patches.radiance.shape), patches.radiance.dtype)
    for border in borders:
        along = np.take(solved, -border.last, border.axis)  # where the surface reaches it, by pixel
        reached = np.logical_or.reduceat(along, np.arange(0, len(along), patches.side))
        for way, goes_on in ((MIRRORED, border.mirrored(patches, camera, directions)), (TURNED, border.turned(patches))):
            some = np.flatnonzero(reached[patches.cells[:, 1 - border.axis]] & np.isfinite(goes_on.centres).all(axis=1))
            if len(some):  # else too little of a patch reaches it
                light[way] += goes_on.some(some).light_on(patches, height, projection_of(camera))
    return light
