"""The cameras of a manifest: projection, lens distortion, the conversion between pixels and camera-frame points, other cameras."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stage.model import FirstFault, Fraction, Positive, Resolution, Strict, Text
from stage.pixels import Crop
from stage.transforms import Transform, pixel_centres

UNDISTORT_ITERATIONS, FARTHEST = 20, 1e6
"""The number of fixed-point iterations that invert the distortion, where ordinary lenses converge to 1e-10 in about ten, and the largest
coordinate that is returned where they run off, because the lens as it was calibrated has no such place."""


class Distortion(Strict):
    """The Brown-Conrady lens distortion: OpenCV's k1 k2 k3 and p1 p2, on axes x right, y down, z forward.

    Source: Brown, "Decentering distortion of lenses", Photogrammetric Engineering 32(3), 1966.
    """

    model: Literal["brown_conrady"]
    """The model of the distortion."""
    k: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The radial coefficients k1, k2 and k3 of OpenCV."""
    p: tuple[float, float] = (0.0, 0.0)
    """The tangential coefficients p1 and p2 of OpenCV."""

    def apply(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distorted image-plane coordinates of ideal ones, x = X/Z and y = Y/Z, arrays of one shape."""
        (k1, k2, k3), (p1, p2) = self.k, self.p
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)

    def undo(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ideal image-plane coordinates that `apply` distorts to x and y, found by fixed-point iteration."""
        ideal_x, ideal_y = x, y
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(UNDISTORT_ITERATIONS):
                distorted_x, distorted_y = self.apply(ideal_x, ideal_y)
                ideal_x, ideal_y = ideal_x + (x - distorted_x), ideal_y + (y - distorted_y)
        return np.clip(ideal_x, -FARTHEST, FARTHEST), np.clip(ideal_y, -FARTHEST, FARTHEST)


class Camera(Strict):
    """A camera at one position.

    A perspective camera is given by `focal_px` and `principal_px`, an orthographic camera by `pixel_size_m`.
    """

    projection: Literal["perspective", "orthographic"]
    """How the camera projects: `orthographic` for a distant camera, or one that nobody calibrated."""
    resolution: Resolution
    """The size of every image."""
    focal_px: tuple[Positive, Positive] | None = None
    """The focal lengths along u and v; a perspective camera needs them, an orthographic one has none."""
    principal_px: tuple[float, float] | None = None
    """The principal point, u to the right and v down from the top-left corner of the image: OpenCV's cx + 0.5 and cy + 0.5. None: the
    centre of the image."""
    distortion: Distortion | None = None
    """The lens distortion of a perspective camera; None: none."""
    pixel_size_m: Positive | None = None
    """The side of a pixel on the object, of an orthographic camera; None: a scene of unknown scale."""
    surface_z_m: float | None = None
    """The camera-frame z of the mean of the masked surface; a perspective camera sees z below 0. None: under near lights what
    `relit solve` estimates; else 0 for an orthographic camera, and a scene of unknown scale for a perspective one."""
    world_from_camera: Transform | None = None
    """The place of the camera in the world, which assets have too; None: the world is the camera frame."""

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
        """The number of columns of an image."""
        return self.resolution[0]

    @property
    def height(self) -> int:
        """The number of rows of an image."""
        return self.resolution[1]

    @property
    def metric(self) -> bool:
        """True when solved heights are in metres; otherwise they are in units of pixels."""
        return self.pixel_size_m is not None if self.projection == "orthographic" else self.surface_z_m is not None

    @property
    def pose(self) -> np.ndarray:
        """`world_from_camera`, [4, 4] float64, or that of a camera which is the world."""
        return np.eye(4) if self.world_from_camera is None else np.array(self.world_from_camera, dtype=np.float64)

    def cropped(self, crop: Crop) -> "Camera":
        """Return the camera whose image is a part of the image of this one: its principal point moves, its frame stays."""
        cu, cv = self.principal_point
        return self.model_copy(update={"resolution": (crop.width, crop.height), "principal_px": (cu - crop.x, cv - crop.y)})

    def plane_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the point at which the line of sight of each pixel crosses the reference plane of the camera.
        Returns x to the right and y upwards, each [rows, cols] float64. For a perspective camera the plane is z = -1, so that (x, y, -1)
        points along the line of sight. For an orthographic camera x and y are the camera-frame coordinates of the line of sight, in metres,
        or in pixels when the capture has no scale."""
        return self.plane_at(*pixel_centres(self.width, self.height))

    def plane_views(self, first_row: int = 0, rows: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return `plane_coordinates` of some rows of the image that cannot be written to.

        Without distortion they are views of one row and of one column, and take no memory.
        """
        count = self.height - first_row if rows is None else rows
        u, v = np.arange(self.width) + 0.5, np.arange(first_row, first_row + count) + 0.5
        if self.distortion is not None:
            return self.plane_at(*np.meshgrid(u, v))
        x, y = self.plane_at(u, v)
        return np.broadcast_to(x, (count, self.width)), np.broadcast_to(y[:, None], (count, self.width))

    @property
    def principal_point(self) -> tuple[float, float]:
        """Image coordinates of the principal point, pixels: `principal_px`, or the centre of the image where it is not given."""
        return self.principal_px or (self.width / 2, self.height / 2)

    def plane_at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `plane_coordinates` of any image coordinates u and v, which may lie between pixel centres or outside the image."""
        cu, cv = self.principal_point
        if self.projection == "orthographic":
            pixel = self.pixel_size_m or 1.0
            return (u - cu) * pixel, (cv - v) * pixel
        assert self.focal_px is not None  # the validator saw to it
        x, down = (u - cu) / self.focal_px[0], (v - cv) / self.focal_px[1]
        if self.distortion is not None:
            x, down = self.distortion.undo(x, down)
        return x, -down

    def lines_of_sight(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the origin and the direction of the line of sight of each image point, of coordinates as of `plane_at`.
        Returns origin [..., 3] and unit direction [..., 3] away from the camera, camera frame, float64. The origin is the centre of a
        perspective camera, and lies on z = 0 for an orthographic camera."""
        x, y = self.plane_at(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
        zero = np.zeros_like(x)
        if self.projection == "orthographic":
            return np.stack([x, y, zero], axis=-1), np.stack([zero, zero, zero - 1], axis=-1)
        toward = np.stack([x, y, zero - 1], axis=-1)
        return np.zeros_like(toward), toward / np.linalg.norm(toward, axis=-1, keepdims=True)

    def image_coordinates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the image coordinates at which the camera sees points: the inverse of `plane_at`.
        `points`: [..., 3] camera frame, in front of a perspective camera; metres, or pixels when the capture has no scale. Returns u and v,
        each [...] float64."""
        x, y, z = np.moveaxis(points.astype(np.float64), -1, 0)
        cu, cv = self.principal_point
        if self.projection == "orthographic":
            pixel = self.pixel_size_m or 1.0
            return cu + x / pixel, cv - y / pixel
        assert self.focal_px is not None  # the validator saw to it
        x, down = -x / z, y / z
        if self.distortion is not None:
            x, down = self.distortion.apply(x, down)
        return cu + self.focal_px[0] * x, cv + self.focal_px[1] * down

    def pixels_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the pixels in which the camera sees points, whatever hides them: their rows and columns, 0 of those outside, and which lie
        inside the image, each [n].
        `points`: [n, 3] as of `image_coordinates`; none behind a perspective camera lies inside."""
        front = points[:, 2] < 0 if self.projection == "perspective" else np.ones(len(points), dtype=bool)
        u, v = self.image_coordinates(np.where(front[:, None], points, [0.0, 0.0, -1.0]))
        col, row = (np.clip(np.floor(np.nan_to_num(at)), -1, side).astype(np.int64)
                    for at, side in ((u, self.width), (v, self.height)))
        inside = front & (col >= 0) & (row >= 0) & (col < self.width) & (row < self.height)
        return np.where(inside, row, 0), np.where(inside, col, 0), inside

    def points(self, height: np.ndarray, first_row: int = 0) -> np.ndarray:
        """Return the camera-frame points of a height map.
        `height`: [rows, cols] camera-frame z, negative in front of a perspective camera, of the whole image or of some of its rows. Returns
        [rows, cols, 3] float32, in the unit of `height`."""
        return self._raised(*self.plane_views(first_row, len(height)), height)

    def points_over(self, u: np.ndarray, v: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Return the camera-frame points that the camera sees at image coordinates, as `points` does.
        `u`, `v`: as of `plane_at`. `height`: [...] camera-frame z. Returns [..., 3] float32, in the unit of `height`."""
        return self._raised(*self.plane_at(u, v), height)

    def points_at(self, pixels: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Return the camera-frame points of single pixels, as `points` does.
        `pixels`: [n] row-major positions in the image. `height`: [n] camera-frame z. Returns [n, 3] float32, in the unit of `height`."""
        row, col = np.divmod(pixels, self.width)
        return self.points_over(col + 0.5, row + 0.5, height)

    def _raised(self, x: np.ndarray, y: np.ndarray, height: np.ndarray) -> np.ndarray:
        if self.projection == "perspective":
            x, y = -x * height, -y * height
        points = np.empty((*height.shape, 3), dtype=np.float32)
        for axis, values in enumerate((x, y, height)):
            points[..., axis] = values
        return points


class OtherCamera(Strict):
    """A perspective camera beside the camera of the capture, with the intrinsics and conventions of that camera."""

    name: Text
    """The name of the camera, for reports and messages."""
    resolution: Resolution
    """The size of every image of this camera."""
    focal_px: tuple[Positive, Positive] | None = None
    """The focal lengths along u and v. None: not measured yet, and `camera_from_other` neither; `relit calibrate stereo` measures both."""
    principal_px: tuple[float, float] | None = None
    """The principal point, as of the camera; None: the centre of the image."""
    distortion: Distortion | None = None
    """The lens distortion; None: none."""
    camera_from_other: Transform | None = None
    """The place of this camera in the camera frame, with the translation in metres; it looks along its own -z. None: not measured yet."""
    depth_sigma: Fraction | None = None
    """The standard deviation of depths that are triangulated with it, as a part of the depth, which the calibration leaves open and all
    pixels share, as `relit calibrate stereo` writes it; None: not known."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.focal_px is None) != (self.camera_from_other is None):
            given, missing = ("focal_px", "camera_from_other") if self.camera_from_other is None else ("camera_from_other", "focal_px")
            raise ValueError(f"{missing} is missing beside {given}: give both, or neither before relit calibrate stereo measures them")
        return self

    @property
    def camera(self) -> Camera:
        """The camera alone, in its own frame."""
        return Camera(projection="perspective", resolution=self.resolution, focal_px=self.focal_px, principal_px=self.principal_px,
                      distortion=self.distortion)


class StereoImages(Strict):
    """Images of the other cameras at the moment of a frame, under projected texture without a code."""

    images: Annotated[tuple[Text, ...], Field(min_length=1), FirstFault]
    """The image of each of `other_cameras`, in their order; files of the folder that no other frame has."""
