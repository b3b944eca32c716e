"""What `relit solve` takes."""

from enum import StrEnum
from pathlib import Path

from service.requests.base import Request, StackOptions


class Method(StrEnum):
    """How normals are solved."""

    LAMBERT = "lambert"
    """Least squares on every light that gave a reading."""
    ROBUST = "robust"
    """Shadows and highlights rejected per pixel."""
    GRADIENT = "gradient"
    """Diffuse and specular normals from spherical gradient frames."""
    REFERENCE = "reference"
    """From a ball of the object's material, photographed under the same lights."""
    SVBRDF = "svbrdf"
    """Normal, diffuse albedo, specular and roughness; the default where there are lights enough."""


class SolveOptions(StackOptions):
    """How normals, albedo and height are solved."""

    method: Method | None = None
    """None: gradient where there are gradient frames; else svbrdf where there are lights enough, else robust."""


class SolveRequest(SolveOptions, Request):
    """Normals, albedo and height of a capture."""

    capture: Path
    out: Path
    """Folder for maps.exr and report.json."""
    reference_ball: Path | None = None
    """Capture of a ball of the object's material under the same lights, for the method reference."""
