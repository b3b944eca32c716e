"""What every command that writes pictures under new light takes."""

from enum import StrEnum
from typing import Annotated

from pydantic import BeforeValidator, Field

from service.requests.base import Options, split_commas
from stage.model import FirstFault

MAX_STOPS = 32.0
"""Of exposure either way: more than half has from its smallest value to its largest."""


class Layer(StrEnum):
    """What a relit frame may carry."""

    BEAUTY = "beauty"
    """The relit image: R, G, B; always there."""
    DIFFUSE = "diffuse"
    """The relit image without the specular layer."""
    SPECULAR = "specular"
    """What a model of the solved maps reflects as from a gloss."""
    MASK = "mask"
    """Where the object is: of the solved maps, else of the capture."""
    NORMAL = "normal"
    """Of the solved maps."""
    CONFIDENCE = "confidence"
    """Of the solved maps."""


class FrameSpace(StrEnum):
    """Colour spaces that relit frames can be written in, beside the capture's own."""

    REC709 = "lin_rec709_scene"
    ACESCG = "lin_ap1_scene"


class FrameCompression(StrEnum):
    """How relit frames are packed."""

    ZIP = "zip"
    PIZ = "piz"
    DWAA = "dwaa"
    """Lossy, and smaller."""


class PictureOptions(Options):
    """How a picture under new light is written."""

    exposure: float = Field(default=0.0, ge=-MAX_STOPS, le=MAX_STOPS, allow_inf_nan=False)
    """Stops: every picture is multiplied by 2 to this power."""
    aov: Annotated[tuple[Layer, ...], FirstFault, BeforeValidator(split_commas)] = (Layer.BEAUTY,)
    """Layers of a picture; as text, names with commas between."""
    color_space: FrameSpace | None = None
    """None: the capture's own scene-linear space."""
    compression: FrameCompression = FrameCompression.ZIP
