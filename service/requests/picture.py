"""What all requests for pictures under new light have in common."""

from typing import Annotated

from pydantic import Field

from service.requests.base import Choice, Commas, Options, Spelling
from stage.model import FirstFault

MAX_STOPS = 32.0
"""The largest exposure, up or down: more than half has between its smallest and its largest value."""


class Layer(Choice):
    """A layer of a relit frame."""

    BEAUTY = "beauty", "the relit image, always there"
    DIFFUSE = "diffuse", "the same without the specular layer"
    SPECULAR = "specular", "what a model of the solved maps reflects as from a gloss"
    MASK = "mask", "where the object is: of the solved maps, else of the capture"
    NORMAL = "normal", "of the solved maps"
    CONFIDENCE = "confidence", "of the solved maps"


class FrameSpace(Choice):
    """Colour spaces that relit frames can be written in, beside the capture's own."""

    REC709 = "lin_rec709_scene"
    ACESCG = "lin_ap1_scene", "ACEScg"


class FrameCompression(Choice):
    """How relit frames are packed."""

    ZIP = "zip", "keeps every bit"
    PIZ = "piz", "keeps every bit"
    DWAA = "dwaa", "lossy and smaller"


class PictureOptions(Options):
    """How a picture under new light is written."""

    exposure: Annotated[float, Spelling(metavar="STOPS")] = Field(default=0.0, ge=-MAX_STOPS, le=MAX_STOPS, allow_inf_nan=False)
    """Stops: every picture is multiplied by 2 to this power."""
    aov: Annotated[tuple[Layer, ...], FirstFault, Commas, Spelling(metavar="LAYERS")] = (Layer.BEAUTY,)
    """Layers of a picture, as text with commas between; diffuse, specular, normal and confidence need solved maps."""
    color_space: FrameSpace | None = None
    """Colour space of the pictures; None: the scene-linear space of the capture or the maps."""
    compression: FrameCompression = FrameCompression.ZIP
    """How pictures are packed."""
