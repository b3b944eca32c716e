"""Texture images of a glTF material: PNG files, packed as its metallic-roughness model reads them.

Source: glTF 2.0 Specification, 3.9.2 "Metallic-Roughness Material" and 3.9.3 "Additional Textures": base colours have 8 bits and the sRGB
curve, which is written with the primaries of Rec.709; the other images are linear and may have more bits.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from service.asset.errors import AssetError
from service.asset.mesh import SurfaceMesh
from service.asset.metallic import MetallicLook
from service.asset.textures import BLEED_TEXELS, DATA_SPACE, DISPLAY_SPACE, Texture, bleed, encode, encode_normals, side_by_side
from service.requests.export import TextureFormat
from stage.images import write_png
from stage.maps import SurfaceMaps

BASE_COLOR, METALLIC_ROUGHNESS, NORMAL = "base_color", "metallic_roughness", "normal"
"""The images of a material."""


def check_textures(target: Path, storage: TextureFormat) -> None:
    """Check that a .glb can hold textures that are stored so.

    Raises:
        AssetError: it cannot hold EXR images.
    """
    if storage is TextureFormat.EXR:
        raise AssetError(f"{target} cannot hold EXR textures: a .glb takes PNG; store the textures as png16, or export a .usda or .usdc")


def write_textures(maps: SurfaceMaps, mesh: SurfaceMesh, folder: Path, *, look: MetallicLook | None,
                   storage: TextureFormat = TextureFormat.PNG16,
                   progress: Callable[[str, float], None] = lambda name, done: None) -> dict[str, Texture]:
    """Write the images that a glTF material of solved maps uses.

    Args:
        mesh: of these maps; the normal map is relative to its frame.
        folder: exists.
        look: of these maps, where they have reflectance.
        storage: PNG16 or PNG8, the bits of the images that are no colours.
        progress: is called before each image is waited for, with its name and the part that is done, 0…1.

    Returns:
        By name; METALLIC_ROUGHNESS only where a highlight was fitted.

    Raises:
        AssetError: the colour space of the maps has no known conversion to Rec.709.
        OSError: a file cannot be written.
    """
    reach = max(BLEED_TEXELS, mesh.step)
    data: type[np.unsignedinteger[Any]] = np.uint8 if storage is TextureFormat.PNG8 else np.uint16

    def write(name: str, codes: np.ndarray, known: np.ndarray, clipped: int) -> Texture:
        write_png(folder / f"{name}.png", bleed(codes, known, reach=reach, in_place=True), srgb=name == BASE_COLOR)
        return Texture(f"{name}.png", DISPLAY_SPACE if name == BASE_COLOR else DATA_SPACE, clipped)

    def write_base_color(look: MetallicLook) -> Texture:
        codes, clipped = encode(look.base_color, look.known, maps.color_space, np.uint8)
        return write(BASE_COLOR, codes, look.known, clipped)

    def write_metallic_roughness(look: MetallicLook, roughness: np.ndarray) -> Texture:
        known = look.known & np.isfinite(roughness)
        green, clipped = encode(roughness, known, None, data)
        blue, _ = encode(look.metallic, known, None, data)
        red = np.full_like(green, np.iinfo(data).max)  # readers that expect three maps in one image take it as no occlusion
        return write(METALLIC_ROUGHNESS, np.stack([red, green, blue], axis=-1), known, clipped)

    def write_normal(normal: np.ndarray) -> Texture:
        codes, known, clipped = encode_normals(normal, maps.mask & np.isfinite(normal.sum(axis=-1)), mesh, data)
        return write(NORMAL, codes, known, clipped)

    writers: dict[str, Callable[[], Texture]] = {}
    if look is not None:
        writers[BASE_COLOR] = partial(write_base_color, look)
        if maps.specular is not None and maps.roughness is not None:
            writers[METALLIC_ROUGHNESS] = partial(write_metallic_roughness, look, maps.roughness)
    if maps.normal is not None:
        writers[NORMAL] = partial(write_normal, maps.normal)
    return side_by_side(writers, progress)
