"""What `relit solve` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import Choice, Request, Role, Spelling, StackOptions


class Method(Choice):
    """How normals are solved."""

    LAMBERT = "lambert", "least squares on every light that gave a reading"
    ROBUST = "robust", "shadows and highlights rejected per pixel"
    GRADIENT = "gradient", "diffuse and specular normals from spherical gradient frames"
    REFERENCE = "reference", "from a ball of the object's material, photographed under the same lights"
    SVBRDF = "svbrdf", "normal, diffuse albedo, specular and roughness"


class SolveOptions(StackOptions):
    """How normals, albedo and height are solved."""

    method: Method | None = None
    """How normals are solved; None: gradient where there are gradient frames; else svbrdf where there are lights enough, else robust."""


class SolveRequest(SolveOptions, Request):
    """Normals, albedo and height of a light-stage capture."""

    capture: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="CAPTURE")]
    """Folder with a capture.json."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for maps.exr and report.json."""
    reference_ball: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Capture of a ball of the object's material under the same lights, for the method reference."""
