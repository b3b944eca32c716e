"""The way of light from a source beside the camera to a surface and back to the camera, and the range that follows from it.

A time-of-flight camera measures the path |p - s| + |p| from the source s to a point p and on to the camera. Half of it, the *half path*,
is the range where the source is at the camera. Points of equal path lie on an ellipsoid with foci s and camera, and each line of sight
meets it once: with the path L, the source s and the unit direction e of the line, all seen from where the line begins,

    range r = (L² - |s|²) / (2·(L - s·e)),      dr/dL = (L - r) / (L - s·e)
"""

from dataclasses import dataclass

import numpy as np

from stage.capture.camera import Camera
from stage.transforms import pixel_centres


@dataclass(frozen=True)
class SourcePath:
    """The place of the source as each line of sight sees it."""

    along_m: np.ndarray  # [rows, cols] float64, s·e: component of the source along the unit direction of the line of sight
    distance_m: np.ndarray  # [rows, cols] float64, |s|: distance of the source from where the line of sight begins

    @classmethod
    def of(cls, camera: Camera, source_m: tuple[float, float, float] | None) -> "SourcePath | None":
        """Return the paths of a camera's pixels, or None for a source at the camera.
        `camera`: of the capture; the lines of sight of an orthographic camera begin in the plane z = 0. `source_m`: place of the source in
        the camera frame, metres."""
        if source_m is None or not any(source_m):
            return None
        origins, rays = camera.lines_of_sight(*pixel_centres(camera.width, camera.height))
        if camera.projection == "orthographic":
            seen = np.array(source_m) - origins
            return cls(-seen[..., 2], np.linalg.norm(seen, axis=-1))
        return cls(rays @ np.array(source_m), np.full(rays.shape[:2], float(np.linalg.norm(source_m))))

    def source_range_m(self, range_m: np.ndarray | float) -> np.ndarray:
        """Return the distance from the source to the points at these ranges, [rows, cols] metres."""
        return np.sqrt(np.maximum(range_m * (range_m - 2 * self.along_m) + self.distance_m**2, 0))

    def half_path_m(self, range_m: np.ndarray | float) -> np.ndarray:
        """Return half of the path of light by way of the points at these ranges, [rows, cols] metres."""
        return 0.5 * (range_m + self.source_range_m(range_m))

    def range_of(self, half_path_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the range of each pixel, and the metres of range that a metre of the half path is.
        `half_path_m`: [rows, cols] metres. A half path of no more than |s|/2 has no point in front of the camera: its range is not above
        zero. Returns two arrays [rows, cols] float64: r, and dr / d(half path)."""
        path = 2 * np.asarray(half_path_m, dtype=np.float64)
        left = np.maximum(path - self.along_m, 1e-9 * self.distance_m)  # above zero for every path longer than |s|
        range_m = 0.5 * (path**2 - self.distance_m**2) / left
        return range_m, np.maximum(2 * (path - range_m) / left, 0)
