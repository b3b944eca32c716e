"""The projector: a camera run backwards."""

from stage.camera import Distortion
from stage.model import Positive, Resolution, Strict, Transform


class Projector(Strict):
    """Same intrinsics and conventions as a perspective camera; "projector column" is the continuous u."""

    resolution: Resolution
    focal_px: tuple[Positive, Positive]
    principal_px: tuple[float, float] | None = None
    distortion: Distortion | None = None
    camera_from_projector: Transform
