"""The camera: projection, lens distortion, and the way between pixels and camera-frame points."""

from typing import Literal, Self

import numpy as np
from pydantic import model_validator

from stage.frames import Transform, pixel_centres
from stage.model import Positive, Resolution, Strict

UNDISTORT_ITERATIONS = 20
"""Fixed-point steps of the inverse distortion; lenses of ordinary strength settle to 1e-10 in about ten."""


class Distortion(Strict):
    """Brown–Conrady lens distortion (Brown 1966), OpenCV's k1 k2 k3 and p1 p2, on x right, y down, z forward."""

    model: Literal["brown_conrady"]
    k: tuple[float, float, float] = (0.0, 0.0, 0.0)
    p: tuple[float, float] = (0.0, 0.0)

    def apply(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distort ideal image-plane coordinates (X/Z, Y/Z)."""
        (k1, k2, k3), (p1, p2) = self.k, self.p
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)

    def undo(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ideal coordinates whose distortion is (x, y), by fixed-point iteration."""
        ideal_x, ideal_y = x, y
        for _ in range(UNDISTORT_ITERATIONS):
            distorted_x, distorted_y = self.apply(ideal_x, ideal_y)
            ideal_x, ideal_y = ideal_x + (x - distorted_x), ideal_y + (y - distorted_y)
        return ideal_x, ideal_y


class Camera(Strict):
    """One camera position. Perspective uses focal_px and principal_px; orthographic uses pixel_size_m."""

    projection: Literal["perspective", "orthographic"]
    resolution: Resolution
    focal_px: tuple[Positive, Positive] | None = None
    principal_px: tuple[float, float] | None = None
    distortion: Distortion | None = None
    pixel_size_m: Positive | None = None
    surface_z_m: float | None = None
    """Camera-frame z of the mean of the masked surface; None: 0 for orthographic, unknown scale for perspective."""
    world_from_camera: Transform | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.projection == "perspective":
            if self.focal_px is None:
                raise ValueError("focal_px is missing: a perspective camera needs it")
            if self.pixel_size_m is not None:
                raise ValueError("pixel_size_m is for orthographic cameras")
            if self.surface_z_m is not None and self.surface_z_m >= 0:
                raise ValueError("surface_z_m must be negative: a perspective camera looks along -z from z = 0")
        else:
            for name in ("focal_px", "distortion"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name} is for perspective cameras")
        return self

    @property
    def width(self) -> int:
        """Columns."""
        return self.resolution[0]

    @property
    def height(self) -> int:
        """Rows."""
        return self.resolution[1]

    @property
    def metric(self) -> bool:
        """Whether solved heights are in metres; otherwise they are in units of pixels."""
        return self.pixel_size_m is not None if self.projection == "orthographic" else self.surface_z_m is not None

    def plane_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each pixel's line of sight crosses the camera's reference plane.

        Returns:
            x right and y up, each [rows, cols] float64. Perspective: the point of the ray at z = -1, so that
            (x, y, -1) is along the line of sight. Orthographic: camera-frame x and y of the line, in metres,
            or in pixels when the capture has no scale.
        """
        return self.plane_at(*pixel_centres(self.width, self.height))

    def plane_at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`plane_coordinates` at any continuous image coordinates, which may lie between pixel centres or off the image."""
        cu, cv = self.principal_px or (self.width / 2, self.height / 2)
        if self.projection == "orthographic":
            pixel = self.pixel_size_m or 1.0
            return (u - cu) * pixel, (cv - v) * pixel
        assert self.focal_px is not None  # the validator saw to it
        x, down = (u - cu) / self.focal_px[0], (v - cv) / self.focal_px[1]
        if self.distortion is not None:
            x, down = self.distortion.undo(x, down)
        return x, -down

    def points(self, height: np.ndarray) -> np.ndarray:
        """Camera-frame points of a height map.

        Args:
            height: [rows, cols] camera-frame z (negative in front of a perspective camera).

        Returns:
            [rows, cols, 3] float32, in the unit of `height`.
        """
        x, y = self.plane_coordinates()
        if self.projection == "perspective":
            x, y = -x * height, -y * height
        return np.stack([x, y, height], axis=-1).astype(np.float32)
