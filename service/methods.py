"""The closed choices of requests; apart from them, so that the command line starts without pydantic."""

from enum import StrEnum


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
