"""The other cameras of a manifest, and the images that they took beside a frame."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from stage.capture.camera import Camera, Distortion
from stage.model import FirstFault, Positive, Resolution, Strict, Text
from stage.transforms import Transform


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
    """Images that the other cameras took at the moment of a frame, under projected texture without a code."""

    images: Annotated[tuple[Text, ...], Field(min_length=1), FirstFault]
    """The image of each of `other_cameras`, in their order; files of the folder that no other frame has."""
