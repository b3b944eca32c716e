"""The projector: a camera run backwards."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from stage.camera import Distortion
from stage.frames import Transform
from stage.model import FirstFault, NotNegative, Positive, Resolution, Rgb, Strict


class Projector(Strict):
    """Same intrinsics and conventions as a perspective camera; "projector column" is the continuous u."""

    resolution: Resolution
    focal_px: tuple[Positive, Positive]
    principal_px: tuple[float, float] | None = None
    distortion: Distortion | None = None
    camera_from_projector: Transform
    response: Annotated[tuple[NotNegative, ...], Field(min_length=2), FirstFault] | None = None
    """Its light at so many even levels from 0 to 1, rising; None: linear. Written by `relit calibrate response`."""
    crosstalk: tuple[Rgb, Rgb, Rgb] | None = None
    """Rows: what the camera's red, green and blue see of the projector's red, green and blue; None: each its own."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.response is not None and any(b <= a for a, b in zip(self.response, self.response[1:], strict=False)):
            raise ValueError("response must rise: each value above the one before")
        return self
