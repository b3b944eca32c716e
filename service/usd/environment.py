"""Environments as UsdLux dome lights, with their lat-long textures in linear Rec.709, which clients take the values of a light to be.

Source: OpenUSD, UsdLuxDomeLight (texture:file, latlong: +y at the top, +z in the middle, as OpenEXR's environment maps);
    UsdColorSpaceAPI and the metadata `colorSpace` of attributes.
"""

from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdLux

from stage import exr
from stage.colour import convert
from stage.environment_maps import read_environment

LIGHT_SPACE = "lin_rec709_scene"
"""Colour space of the lights: their colours have no declaration that clients read, and all take them as this."""


def write_dome_texture(environment: Path, texture: Path, *, clipped: dict[str, int] | None = None) -> None:
    """Write an environment map as the texture of a dome light.

    Args:
        environment: lat-long .exr or .hdr.
        clipped: as in stage.environment_maps.read_environment.
        texture: the .exr; half where half holds every value, else float32.

    Raises:
        ImageError: impossible values, or a colour space that is not known.
        StorageError: a file cannot be read or written.
    """
    write_radiance(read_environment(environment, LIGHT_SPACE, clipped=clipped), texture)


def write_radiance(radiance: np.ndarray, texture: Path) -> None:
    """Write radiance [rows, cols, 3] in LIGHT_SPACE as the texture of a dome light: half where half holds the largest value."""
    pixels = radiance.astype(np.float16) if radiance.max() <= exr.HALF_MAX else radiance.astype(np.float32)
    exr.write(texture, {name: pixels[..., channel] for channel, name in enumerate("RGB")}, color_space=LIGHT_SPACE, metadata={})


def define_dome(usd_stage: Usd.Stage, path: Sdf.Path, texture: str | None) -> UsdLux.DomeLight:
    """Define a dome light of intensity 1 whose texture, relative to the layer, is the radiance from every direction; None: white."""
    dome = UsdLux.DomeLight.Define(usd_stage, path)
    dome.CreateIntensityAttr(1.0)
    if texture is not None:
        file = dome.CreateTextureFileAttr(Sdf.AssetPath(texture))
        file.SetColorSpace(LIGHT_SPACE)
        dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    return dome


def light_colour(rgb: tuple[float, float, float], space: str) -> tuple[float, tuple[float, float, float]]:
    """Return the intensity and colour of a light from its red, green and blue in a scene-linear colour space.

    Returns:
        The largest channel in LIGHT_SPACE, and the channels over it; a channel outside of its gamut is 0.
    """
    channels = np.maximum(convert(np.array([[rgb]], np.float32), space, LIGHT_SPACE)[0, 0].astype(np.float64), 0)
    intensity = float(channels.max())
    red, green, blue = channels / (intensity or 1.0)
    return intensity, (red, green, blue)
