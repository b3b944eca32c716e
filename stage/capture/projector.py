"""The projector of a manifest, and the projection of camera-frame points into its image."""

from collections.abc import Mapping
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from stage.capture.camera import Distortion
from stage.model import FirstFault, Fraction, NotNegative, Positive, Resolution, Rgb, Strict
from stage.transforms import OPENCV_FROM_CAMERA, Transform


class UncalibratedProjector(Strict):
    """A projector whose lens and place nobody has measured yet: how many pixels it has, and what its light does."""

    resolution: Resolution
    """The size of the image that the projector shows."""
    response: Annotated[tuple[NotNegative, ...], Field(min_length=2), FirstFault] | None = None
    """The light of the projector at even levels from 0 to 1, rising, as `relit calibrate response` writes it; None: linear."""
    crosstalk: tuple[Rgb, Rgb, Rgb] | None = None
    """The rows are the red, green and blue that the camera records of the red, green and blue of the projector; None: no crosstalk."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.response is not None and any(b <= a for a, b in zip(self.response, self.response[1:], strict=False)):
            raise ValueError("response must rise: each value above the one before")
        return self


class Projector(UncalibratedProjector):
    """A projector, with the intrinsics and conventions of a perspective camera; its column and row are the continuous u and v."""

    focal_px: tuple[Positive, Positive]
    """The focal lengths along u and v."""
    principal_px: tuple[float, float] | None = None
    """The principal point, as of the camera; None: the centre of the image."""
    distortion: Distortion | None = None
    """The lens distortion; None: none."""
    camera_from_projector: Transform
    """The place of the projector in the camera frame, with the translation in metres; the projector looks along its own -z."""
    depth_sigma: Fraction | None = None
    """The standard deviation of depths that are triangulated with it, as a part of the depth, which the calibration leaves open and all
    pixels share, as `relit calibrate procam` writes it; None: not known."""

    def projector_from_camera(self) -> np.ndarray:
        """Return the transform from the camera frame to the frame of the projector with OpenCV's axes, x right, y down, z forward.
        Returns [3, 4] float64: point_device = matrix @ (x, y, z, 1)."""
        pose = np.array(self.camera_from_projector, dtype=np.float64)
        rotation = OPENCV_FROM_CAMERA @ pose[:3, :3].T
        return np.column_stack([rotation, -rotation @ pose[:3, 3]])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project camera-frame points into the image of the projector.
        `points`: [..., 3] metres, camera frame. Returns [..., 2] continuous column and row, and [...] bool: True for points in front of the
        projector."""
        matrix = self.projector_from_camera()
        point_device = points @ matrix[:, :3].T + matrix[:, 3]
        ahead = point_device[..., 2] > 0
        z = np.where(ahead, point_device[..., 2], 1.0)
        x, y = point_device[..., 0] / z, point_device[..., 1] / z
        if self.distortion is not None:
            x, y = self.distortion.apply(x, y)
        cu, cv = self.principal_px or (self.resolution[0] / 2, self.resolution[1] / 2)
        return np.stack([cu + self.focal_px[0] * x, cv + self.focal_px[1] * y], axis=-1), ahead


def _calibration(given: Any) -> str:
    """Return which of the two projectors a value is meant to be: without a field of its lens or place it is not calibrated."""
    if isinstance(given, Mapping):
        calibrated = any(given.get(name) is not None for name in Projector.model_fields.keys() - UncalibratedProjector.model_fields.keys())
    else:
        calibrated = not isinstance(given, UncalibratedProjector) or isinstance(given, Projector)
    return "calibrated" if calibrated else "uncalibrated"


AnyProjector = Annotated[Annotated[Projector, Tag("calibrated")] | Annotated[UncalibratedProjector, Tag("uncalibrated")],
                         Discriminator(_calibration)]
"""A projector of a manifest, with lens and place or without both."""
