"""The options of `relit calibrate chart`."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base.base import CAPTURE, Choice, Commas, Options, Role, Spelling
from service.requests.base.review import ReviewOptions
from service.requests.calibrate import ManifestRequest
from stage.model import Finite


class ChartKind(Choice):
    """The colour charts that are found in images."""

    CLASSIC = "classic", "24 patches"
    PASSPORT = "passport", "the 24 patches of a ColorChecker Passport, which are those of the classic chart"
    SG = "sg", "the 140 patches of a ColorChecker Digital SG"


class ChartIlluminant(Choice):
    """The lights under which colours of charts are computed."""

    D50 = "D50"
    D65 = "D65"


class ChartOptions(Options):
    """The colour chart, and where it is."""

    chart: ChartKind = ChartKind.CLASSIC
    """The colour chart."""
    corners: Annotated[tuple[Finite, ...], Field(min_length=8, max_length=8), Commas, Spelling(metavar="U,V,…")] | None = None
    """Pixels of the centres of four patches of the chart: the first, the last of the first row, the last, and the first of the last row;
    None: the chart is found in the images."""
    illuminant: ChartIlluminant = ChartIlluminant.D50
    """The light of the colours in `reflectances`, where the file does not name it."""


class ChartRequest(ReviewOptions, ChartOptions, ManifestRequest):
    """The colours of the capture from a colour chart in its frames: a matrix for each kind of light, and how far each patch is off."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder of a capture whose frames show the chart."""
    apply_to: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Another capture of the same camera under the same kinds of light, whose manifest is written; None: the capture itself."""
    reflectances: Annotated[Path | None, Role.INPUT, Spelling(metavar="FILE")] = None
    """The colours of the chart's patches in reading order: CGATS, or CSV with the columns name and l,a,b or x,y,z or r,g,b; None: those
    that X-Rite published for charts since November 2014."""
