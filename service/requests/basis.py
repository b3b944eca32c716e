"""The options of `relit basis`."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base.base import CAPTURE, Choice, Request, Role, StackOptions


class BasisKind(Choice):
    """The kind of basis to which a capture is reduced."""

    SVD = "svd", "singular value decomposition, which loses least with so many coefficients (.exr)"
    PTM = "ptm", "polynomial texture map, six coefficients in each channel (.ptm)"
    LRGB_PTM = "lrgb-ptm", "polynomial texture map of the luminance, with one colour for each pixel; half the size (.ptm)"
    HSH = "hsh", "hemispherical harmonics (.rti)"


class BasisCount(StackOptions):
    """The number of coefficients that are kept."""

    count: int | None = Field(default=None, ge=1)
    """Coefficients in each channel. svd: 1 to the number of lights; hsh: 4, 9 or 16; both kinds of ptm: always 6. None: svd: 16, or the
    number of lights if that is smaller; hsh: 9 with 18 lights or more, else 4."""


class BasisOptions(BasisCount):
    """The basis to which a job of the service reduces a capture."""

    basis: BasisKind = BasisKind.SVD
    """The kind of basis to which the capture is reduced."""


class BasisRequest(BasisCount, Request):
    """A capture as a few coefficient images, for a browser or for RTI viewers."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json."""
    out: Annotated[Path, Role.FILE]
    """The file: .exr, .ptm or .rti; a .json that describes it is written beside it."""
    kind: BasisKind | None = None
    """The kind of basis to which the capture is reduced; None: the first kind with the suffix of `out`."""
