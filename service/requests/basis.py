"""What `relit basis` takes."""

from enum import StrEnum
from pathlib import Path

from pydantic import Field

from service.requests.base import Request, StackOptions


class BasisKind(StrEnum):
    """What a capture is reduced to."""

    SVD = "svd"
    """The coefficient images that lose least, in an EXR."""
    PTM = "ptm"
    """Polynomial texture map, six coefficients in each channel."""
    LRGB_PTM = "lrgb-ptm"
    """Polynomial texture map of the luminance, and one colour a pixel: half the size."""
    HSH = "hsh"
    """Hemispherical harmonics, in an RTI file."""


class BasisRequest(StackOptions, Request):
    """A capture reduced to a few coefficient images, for a browser or for viewers of relightable images."""

    capture: Path
    out: Path
    """.exr (svd), .ptm (ptm, lrgb-ptm) or .rti (hsh)."""
    kind: BasisKind | None = None
    """None: the first kind with the suffix of `out`."""
    count: int | None = Field(default=None, ge=1)
    """Coefficients in each channel. svd: 1 to the number of lights, None: 16 or that number; hsh: 4, 9 or 16, None: 9 from 18
    lights on, else 4; ptm: six in any case."""
