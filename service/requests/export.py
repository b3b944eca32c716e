"""What `relit export` takes."""

from pathlib import Path
from typing import Annotated, Literal

from service.requests.base import Choice, Options, Role, Spelling

AssetFormat = Literal["usdz", "usda", "usdc"]


class Geometry(Choice):
    """What an asset of a depth is made of."""

    MESH = "mesh", "faces between neighbouring pixels of one surface"
    POINTS = "points", "the measured points"


class ExportOptions(Options):
    """What a USD asset is called and made of."""

    name: str | None = None
    """Name of the asset; None: the name that the maps have, else the stem of the file's name."""
    geometry: Geometry | None = None
    """What an asset of a depth (depth.exr in place of maps.exr) is made of; None: mesh."""


class ExportRequest(ExportOptions):
    """A USD asset of solved maps with their material, or of a depth with its colours."""

    maps: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="DIR")]
    """Folder with maps.exr or depth.exr, or the file."""
    out: Annotated[Path, Role.OUTPUT]
    """The asset: .usdz, .usda or .usdc."""
