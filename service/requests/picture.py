"""What all requests for pictures under new light have in common."""

from typing import Annotated

from pydantic import Field

from service.requests.base import Choice, Commas, Options, Spelling
from stage.model import FirstFault

MAX_STOPS = 32.0
"""The largest exposure, up or down: more than half has between its smallest and its largest value."""


class Layer(Choice):
    """A layer of a relit frame."""

    BEAUTY = "beauty", "the relit image, always written"
    DIFFUSE = "diffuse", "the relit image less the specular layer"
    SPECULAR = "specular", "the specular reflection of the model of the solved maps"
    MASK = "mask", "the pixels of the object: the mask of the solved maps, else of the capture"
    NORMAL = "normal", "the normals of the solved maps"
    CONFIDENCE = "confidence", "the confidence of the solved maps"


class FrameSpace(Choice):
    """Colour spaces that relit frames can be written in, beside the capture's own."""

    REC709 = "lin_rec709_scene"
    ACESCG = "lin_ap1_scene", "ACEScg"


class FrameCompression(Choice):
    """Compression of the EXR files of relit frames."""

    ZIP = "zip", "lossless"
    PIZ = "piz", "lossless"
    DWAA = "dwaa", "lossy, smaller files"


class PictureOptions(Options):
    """How a picture under new light is written."""

    exposure: Annotated[float, Spelling(metavar="STOPS")] = Field(default=0.0, ge=-MAX_STOPS, le=MAX_STOPS, allow_inf_nan=False)
    """Exposure in stops: every picture is multiplied by 2 to this power."""
    aov: Annotated[tuple[Layer, ...], FirstFault, Commas, Spelling(metavar="LAYERS")] = (Layer.BEAUTY,)
    """Layers of a picture, as text with commas between; diffuse, specular, normal and confidence need solved maps."""
    color_space: FrameSpace | None = None
    """Colour space of the pictures; None: the scene-linear space of the capture or the maps."""
    compression: FrameCompression = FrameCompression.ZIP
    """Compression of the EXR files."""
