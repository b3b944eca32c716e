"""What `relit export` takes."""

from enum import StrEnum
from pathlib import Path

from service.requests.base import Options


class Geometry(StrEnum):
    """What an asset of a depth is made of."""

    MESH = "mesh"
    """Faces between neighbouring pixels of one surface."""
    POINTS = "points"
    """The measured points."""


class ExportOptions(Options):
    """What a USD asset is called and made of."""

    name: str | None = None
    """Of the asset; None: what the maps say, else the file's stem."""
    geometry: Geometry | None = None
    """Of a depth (depth.exr in place of maps.exr); None: mesh."""


class ExportRequest(ExportOptions):
    """A USD asset from solved maps or a depth."""

    maps: Path
    """A folder with maps.exr or depth.exr, or the file."""
    out: Path
    """.usdz, .usda or .usdc."""
