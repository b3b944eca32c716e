"""Options that all requests for pictures under new light share."""

from typing import Annotated

from pydantic import Field

from service.requests.base.base import Choice, Commas, Options, Spelling
from stage.colour.colour_spaces import LightSpaceName
from stage.model import FirstFault, Positive

MAX_STOPS = 32.0
"""The largest exposure, up or down: more than half has between its smallest and its largest value."""

FrameRate = Annotated[Positive, Field(ge=0.001, le=1000.0)]
"""Frames per second: from one in a quarter of an hour, as in a time lapse, to a thousand."""


class Layer(Choice):
    """A layer of a relit frame."""

    BEAUTY = "beauty", "the relit image, always written"
    DIFFUSE = "diffuse", "the relit image less the specular layer"
    SPECULAR = "specular", "the specular reflection of the model of the solved maps"
    LIGHTS = "lights", "a layer for the environment and for each light and captured image of the light keys, which add up to the image"
    MASK = "mask", "the pixels of the object: the mask of the solved maps, else of the capture"
    NORMAL = "normal", "the normals of the solved maps, in the camera frame"
    WORLD_NORMAL = "world_normal", "these normals in the world frame, as N"
    POSITION = "position", "the points of the solved surface in the world frame, as P"
    DEPTH = "depth", "their distances along the view axis"
    ALBEDO = "albedo", "the diffuse albedo of the solved maps"
    CONFIDENCE = "confidence", "the confidence of the solved maps"


class FrameCompression(Choice):
    """Compression of the EXR files of relit frames."""

    ZIP = "zip", "lossless"
    PIZ = "piz", "lossless"
    DWAA = "dwaa", "lossy, smaller files; layers of data stay lossless"


class FrameParts(Choice):
    """The layout of the layers of a frame in its file."""

    SINGLE = "single", "all in one part"
    MULTI = "multi", "each layer in a part of its own"


class FrameMatte(Choice):
    """The alpha channel of relit frames, by which they are premultiplied."""

    SOFT = "soft", "partly covered pixels have the coverage of the mask image, else one that is estimated from the captured images"
    MASK = "mask", "pixels of the mask are wholly covered, others not at all"
    NONE = "none", "no alpha, and the picture keeps its background"


class PictureOptions(Options):
    """Options for writing a picture under new light."""

    exposure: Annotated[float, Spelling(metavar="STOPS")] = Field(default=0.0, ge=-MAX_STOPS, le=MAX_STOPS, allow_inf_nan=False)
    """Exposure in stops: every picture is multiplied by 2 to this power."""
    aov: Annotated[tuple[Layer, ...], FirstFault, Commas, Spelling(metavar="LAYERS")] = (Layer.BEAUTY,)
    """Layers of a picture, as text with commas between; all but beauty, lights and mask need solved maps."""
    matte: FrameMatte = FrameMatte.SOFT
    """The alpha channel A of the pictures, by which they are premultiplied."""
    color_space: LightSpaceName | None = None
    """Scene-linear colour space of the pictures, such as lin_rec709_scene or ACEScg; None: that of the capture or the maps."""
    compression: FrameCompression = FrameCompression.ZIP
    """Compression of the EXR files."""
    parts: FrameParts | None = None
    """How the layers lie in the file; None: in parts of their own where the compression is lossy, else in one."""
