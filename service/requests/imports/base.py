"""The options that several layouts of `relit import` share."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from service.requests.base.base import Choice, Commas, Options, Role, Spelling
from stage.colour.colour_spaces import ColorSpaceName
from stage.model import Finite, Line, Positive


class ImportRequest(Options):
    """Base of every layout: where the files are, and where the capture comes to be."""

    source: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SRC")]
    """Folder of the data."""
    destination: Annotated[Path | None, Role.OUTPUT, Spelling(argument=True, metavar="DST")] = None
    """Folder for the capture, which gets links to the files; None: SRC, where nothing but capture.json is written."""

    @property
    def folder(self) -> Path:
        """The folder for the capture."""
        return self.destination or (self.source.parent if self.source.is_file() else self.source)


def _one_or_two(values: tuple[float, ...]) -> tuple[float, ...]:
    if len(values) not in (1, 2):
        raise ValueError("give one focal length, or two with a comma between")
    return values


def _four_or_five(values: tuple[float, ...]) -> tuple[float, ...]:
    if len(values) not in (4, 5):
        raise ValueError("give k1,k2,p1,p2 or k1,k2,p1,p2,k3")
    return values


class LensOptions(Options):
    """Focal length, principal point and distortion of a camera's lens."""

    focal_px: Annotated[tuple[Positive, ...] | None, Commas, AfterValidator(lambda v: v and _one_or_two(v)),
                        Spelling(metavar="F[,F]")] = None
    """Focal length in pixels, one or that of columns and rows; None: the camera is orthographic."""
    principal_px: Annotated[tuple[Finite, Finite] | None, Commas, Spelling(metavar="U,V")] = None
    """Principal point in pixels, where the centre of the first pixel is 0.5,0.5 (add 0.5 to OpenCV's); None: the centre of the image."""
    distortion: Annotated[tuple[Finite, ...] | None, Commas, AfterValidator(lambda v: v and _four_or_five(v)),
                          Spelling(metavar="K1,K2,P1,P2[,K3]")] = None
    """Lens distortion as OpenCV has it."""


class CameraOptions(LensOptions):
    """The camera; without a focal length it is taken to be orthographic."""

    pixel_size_m: Positive | None = None
    """Orthographic camera: side of a pixel on the object, metres; None: heights are in pixels."""
    surface_z_m: Finite | None = None
    """Mean z of the object in the camera frame, metres: negative before a perspective camera. None: under near lights relit solve
    estimates it; else it is 0 for an orthographic camera."""


class EncodingOptions(Options):
    """The encoding of images."""

    color_space: ColorSpaceName | None = None
    """Colour space of the images; None: what the files declare, else sRGB for 8-bit images and scene-linear for others."""


class ImageOptions(EncodingOptions):
    """The images of the folder that are frames, and their encoding."""

    images: Annotated[Line | None, Spelling(metavar="GLOB")] = None
    """Names of the frames, such as 'img_*.png'; None: every image but the mask and the ambient image."""
    mask: Annotated[Line | None, Spelling(metavar="NAME")] = None
    """Image of the mask; None: the one with the word mask in its name, if there is one."""
    ambient: Annotated[Line | None, Spelling(metavar="NAME")] = None
    """Image without any of the lights, which is subtracted; None: the one with the word ambient in its name, if there is one."""


class AxisWay(Choice):
    """The direction of an axis, as seen by the camera."""

    RIGHT = "right"
    LEFT = "left"
    UP = "up"
    DOWN = "down"
    TOWARDS = "towards"
    AWAY = "away"


class LightScale(Options):
    """The scale of far lights whose strengths are known but for a factor."""

    scale: Positive | None = None
    """Radiance in the linear images of a white, matt surface that faces a light of strength 1; None: unknown, and so is the scale of
    albedo."""


Axes = Annotated[tuple[AxisWay, AxisWay, AxisWay], Commas, Spelling(metavar="X,Y,Z")]
