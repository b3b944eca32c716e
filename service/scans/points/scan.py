"""One scan in memory: its points with their uncertainty, and what is known of the camera that took it."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera


class Target(NamedTuple):
    """A target that a scan shows."""

    name: str
    position: np.ndarray  # [3] metres, frame of the scan
    covariance: np.ndarray  # [3, 3] square metres


@dataclass(frozen=True, kw_only=True)
class Scan:
    """The points of a scan in its own camera frame, metres: +x right, +y up, +z towards the viewer; the camera looks along -z.

    A range image also has its camera and the pixel of each point, so that the free space before the surface is known: between the camera
    and each point nothing was in the way. Of a pixel without a point nothing is known.
    """

    name: str
    path: Path
    """The depth.exr or the PLY file."""
    points: np.ndarray  # [n, 3] float32 metres
    sigma: np.ndarray  # [n] float32 metres, above 0: standard deviation of the place along the line of sight from `origin`
    sigma_source: str
    """`measured` (in the file), `declared` (in scan-set.json) or `estimated` (from the scatter around local planes)."""
    normals: np.ndarray | None  # [n, 3] float32, unit, those that a PLY file gives; 0 where it gives none
    colours: np.ndarray | None  # [n, 3] uint8, display-encoded (sRGB)
    confidence: np.ndarray | None  # [n] float32 0…1
    origin: np.ndarray  # [3] float64 metres: where the camera is in the scan's frame; an orthographic camera: any point above its image
    camera: Camera | None
    """The camera of a range image; None: a set of points."""
    pixels: np.ndarray | None  # [n] int64 row-major pixel of each point of a range image
    pose: np.ndarray | None  # [4, 4] float64 world_from_scan, its rotation exact to rounding; None: unknown
    pose_covariance: np.ndarray | None  # [6, 6] as `stage.sets.scan_set.Covariance`; None: unknown
    maps: Path | None
    """The maps.exr of the same camera in the same place; None: there is none."""
    targets: tuple[Target, ...] = ()
    """Named targets that the scan shows, in its frame."""

    def image(self, values: np.ndarray) -> np.ndarray:
        """Return values [n] or [n, k] of the points as an image: [rows, cols] or [rows, cols, k] of their type, 0 where no point is."""
        assert self.camera is not None and self.pixels is not None
        image = np.zeros((self.camera.height * self.camera.width, *values.shape[1:]), dtype=values.dtype)
        image[self.pixels] = values
        return image.reshape(self.camera.height, self.camera.width, *values.shape[1:])

    def depth_sigma(self) -> np.ndarray:
        """Return the standard deviation of the depth, not along the line of sight, of each point of a range image, [n] float32 metres."""
        return np.asarray((self.sigma * -self.directions()[:, 2]).astype(np.float32))

    def directions(self) -> np.ndarray:
        """Return the unit vector from the camera through each point, [n, 3] float64."""
        if self.camera is not None and self.camera.projection == "orthographic":
            return np.broadcast_to(np.array([0.0, 0.0, -1.0]), self.points.shape)
        along = self.points.astype(np.float64) - self.origin
        return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), np.finfo(np.float64).tiny)
