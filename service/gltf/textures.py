"""Texture images of a glTF material: PNG files, packed as its metallic-roughness model reads them.

Source: glTF 2.0 Specification, 3.9.2 "Metallic-Roughness Material" and 3.9.3 "Additional Textures": base colours have 8 bits and the sRGB
curve, which is written with the primaries of Rec.709; the other images are linear and may have more bits. Browsers keep 8 of them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.asset.mesh import SurfaceMesh
from service.asset.metallic import GLASS_IOR, metallic_look
from service.asset.textures import BLEED_TEXELS, bleed, quantise, tangent_space, to_display
from stage.images import write_png
from stage.maps import SurfaceMaps

BASE_COLOR, METALLIC_ROUGHNESS, NORMAL = "base_color", "metallic_roughness", "normal"


class SurfaceTextures(NamedTuple):
    """The images of a material."""

    files: dict[str, Path]  # BASE_COLOR, METALLIC_ROUGHNESS and NORMAL, as far as the maps have what is in them
    ior: float  # index of refraction of the dielectric share
    clipped_pixels: dict[str, int]  # image → masked pixels with a channel that had to be cut to 0…1


def write_textures(maps: SurfaceMaps, mesh: SurfaceMesh, folder: Path, *,
                   progress: Callable[[str, float], None] = lambda image, done: None) -> SurfaceTextures:
    """Write the images that a glTF material uses.

    Args:
        mesh: of these maps; the normal map is relative to its frame.
        folder: exists.
        progress: is called before each image with its name and the part that is done, 0…1.

    Raises:
        AssetError: the colour space of the maps has no known conversion to Rec.709.
        OSError: a file cannot be written.
    """
    reach = max(BLEED_TEXELS, mesh.step)
    files: dict[str, Path] = {}
    clipped: dict[str, int] = {}

    def write(image: str, values: np.ndarray, known: np.ndarray, dtype: type[np.unsignedinteger]) -> None:
        codes, clipped[image] = quantise(bleed(values, known, reach=reach), known, dtype)
        files[image] = folder / f"{image}.png"
        write_png(files[image], codes, srgb=image == BASE_COLOR)

    ior = GLASS_IOR
    if maps.diffuse_albedo is not None:
        progress(BASE_COLOR, 0.0)
        look = metallic_look(maps)
        ior = look.ior
        known = maps.mask & np.isfinite(look.base_color.sum(axis=-1))
        write(BASE_COLOR, to_display(np.where(known[..., None], look.base_color, 0), maps.color_space), known, np.uint8)
        if maps.specular is not None and maps.roughness is not None:
            progress(METALLIC_ROUGHNESS, 1 / 3)
            known = maps.mask & np.isfinite(maps.roughness) & np.isfinite(look.metallic)
            unoccluded = np.ones_like(look.metallic)  # red is the occlusion of readers that expect three maps in one image
            write(METALLIC_ROUGHNESS, np.stack([unoccluded, maps.roughness, look.metallic], axis=-1), known, np.uint16)
    if maps.normal is not None:
        progress(NORMAL, 2 / 3)
        encoded, known = tangent_space(maps.normal, maps.mask & np.isfinite(maps.normal.sum(axis=-1)), mesh)
        write(NORMAL, encoded, known, np.uint16)
    return SurfaceTextures(files, ior, clipped)
