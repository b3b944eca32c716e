"""What `relit basis` takes."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base import Choice, Request, Role, Spelling, StackOptions


class BasisKind(Choice):
    """What a capture is reduced to."""

    SVD = "svd", "the coefficient images that lose least (.exr)"
    PTM = "ptm", "polynomial texture map, six coefficients in each channel (.ptm)"
    LRGB_PTM = "lrgb-ptm", "polynomial texture map of the luminance, and one colour a pixel, half the size (.ptm)"
    HSH = "hsh", "hemispherical harmonics (.rti)"


class BasisRequest(StackOptions, Request):
    """A capture as a few coefficient images, for a browser or for RTI viewers."""

    capture: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="CAPTURE")]
    """Folder with a capture.json."""
    out: Annotated[Path, Role.OUTPUT]
    """The file: .exr, .ptm or .rti; a .json with its facts lies beside it."""
    kind: BasisKind | None = None
    """What the capture is reduced to; None: the first kind with the suffix of `out`."""
    count: int | None = Field(default=None, ge=1)
    """Coefficients in each channel. svd: 1 to the number of lights, 16 or that number if left out; hsh: 4, 9 or 16, 9 from 18 lights on,
    else 4, if left out; ptm: six in any case."""
