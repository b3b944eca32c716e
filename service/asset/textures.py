"""Texture images of an asset: 8-bit sRGB PNG for colours, 16-bit raw PNG for normals and roughness.

PNG is what every reader of a USDZ package must know. Values outside 0…1 cannot be kept in it: they are clipped, and
counted.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.asset.errors import AssetError
from service.asset.mesh import SurfaceMesh
from service.asset.tangent import tangent_frame
from stage.colour import convert
from stage.images import write_png
from stage.maps import SurfaceMaps

DISPLAY_SPACE = "srgb_rec709_scene"
"""The space that UsdUVTexture calls sRGB in sourceColorSpace: Rec.709 primaries and the sRGB curve."""

BLEED_TEXELS = 8
"""How far colour is bled over the edge of the mask: bilinear filtering stays clean down to the third mip level."""

LAYERS = ("diffuse_albedo", "normal", "specular", "roughness")
"""Layers that a material uses, in the order they are written."""

_NEIGHBOURS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]

FILE_NAMES = tuple(f"{layer}.png" for layer in LAYERS)
"""Every file that write_textures can write."""


class Texture(NamedTuple):
    """A written image, and how a material has to read it."""

    file_name: str
    color_space: str  # the UsdUVTexture token: sRGB or raw
    clipped_pixels: int  # masked pixels with a channel that had to be cut to 0…1


def write_textures(maps: SurfaceMaps, mesh: SurfaceMesh, folder: Path, *,
                   progress: Callable[[str, float], None] = lambda layer, done: None) -> dict[str, Texture]:
    """Write a texture for each layer that exists and that a material uses.

    Args:
        mesh: of these maps; the normal map is relative to its frame.
        folder: exists.
        progress: is called before each image with the layer's name and the part that is done, 0…1.

    Returns:
        By layer name, in the order of LAYERS.

    Raises:
        AssetError: the colour space of the maps has no known conversion to Rec.709.
        OSError: a file cannot be written.
    """
    reach = max(BLEED_TEXELS, mesh.step)
    written: dict[str, Texture] = {}

    def write(layer: str, values: np.ndarray, known: np.ndarray, dtype: type[np.unsignedinteger]) -> None:
        codes, clipped = quantise(bleed(values, known, reach=reach), known, dtype)
        color_space = "sRGB" if dtype is np.uint8 else "raw"
        write_png(folder / f"{layer}.png", codes, srgb=color_space == "sRGB")
        written[layer] = Texture(f"{layer}.png", color_space, clipped)

    for index, layer in enumerate(LAYERS):
        values = getattr(maps, layer)
        if values is None:
            continue
        progress(layer, index / len(LAYERS))
        values = values.astype(np.float32)
        known = maps.mask & np.isfinite(values if values.ndim == 2 else values.sum(axis=-1))
        if layer == "normal":
            encoded, known = tangent_space(values, known, mesh)
            write(layer, encoded, known, np.uint16)
        elif layer == "roughness":
            write(layer, values, known, np.uint16)
        else:
            write(layer, to_display(np.where(known[..., None], values, 0), maps.color_space), known, np.uint8)
    return written


def quantise(values: np.ndarray, known: np.ndarray, dtype: type[np.unsignedinteger]) -> tuple[np.ndarray, int]:
    """Round values of 0…1 to the codes of an integer type.

    Returns:
        codes, as values; and the number of known pixels with a channel more than half a code outside 0…1.
    """
    top = float(np.iinfo(dtype).max)
    codes = np.floor(values * top + 0.5)
    outside = (codes < 0) | (codes > top)
    clipped = outside if outside.ndim == 2 else outside.any(axis=-1)
    return np.clip(codes, 0, top).astype(dtype), int(np.count_nonzero(clipped & known))


def to_display(values: np.ndarray, color_space: str) -> np.ndarray:
    """Return colours [rows, cols, 3] of the maps in the display space; not clipped.

    Raises:
        AssetError: the colour space has no known conversion.
    """
    try:
        return convert(np.ascontiguousarray(values), color_space, DISPLAY_SPACE)
    except ValueError as error:
        raise AssetError(f"the colour space {color_space} of the maps cannot be converted to {DISPLAY_SPACE}: name one "
                         "that OpenColorIO's default configuration knows") from error


def tangent_space(normal: np.ndarray, known: np.ndarray, mesh: SurfaceMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return normals [rows, cols, 3] as 0…1 in the tangent space of the mesh, and where they are known."""
    frame = tangent_frame(mesh, known.shape)
    length = np.linalg.norm(np.where(known[..., None], normal, 0), axis=-1)
    known = known & frame.covered & (length > 0)
    unit = np.where(known[..., None], normal, 0) / np.where(known, length, 1)[..., None]
    return frame.express(unit) / 2 + 0.5, known


def bleed(values: np.ndarray, known: np.ndarray, *, reach: int) -> np.ndarray:
    """Fill unknown texels from their known neighbours, ring by ring, so that filtering a texture does not darken its border.

    Args:
        values: [rows, cols] or [rows, cols, channels] float32.
        known: [rows, cols] bool; known texels are returned as they are.
        reach: number of rings; texels beyond get the mean of the known ones, for the coarse mip levels.

    Returns:
        An array like `values`; zero throughout when nothing is known.
    """
    planes = values[..., None] if values.ndim == 2 else values
    filled = np.pad(np.where(known[..., None], planes, 0), ((1, 1), (1, 1), (0, 0)))
    done = np.pad(known, 1)
    inside = np.pad(np.ones_like(known), 1)
    ring = _around(np.argwhere(done), done, inside)
    for _ in range(reach):
        if len(ring) == 0:
            break
        total = np.zeros((len(ring), planes.shape[-1]), dtype=np.float32)
        count = np.zeros((len(ring), 1), dtype=np.float32)
        for r, c in _NEIGHBOURS:
            neighbour = ring[:, 0] + r, ring[:, 1] + c
            total += filled[neighbour]  # zero where not done
            count += done[neighbour][:, None]
        filled[ring[:, 0], ring[:, 1]] = total / count
        done[ring[:, 0], ring[:, 1]] = True
        ring = _around(ring, done, inside)
    if known.any():
        filled[~done] = planes[known].mean(axis=0, dtype=np.float64)
    return filled[1:-1, 1:-1].reshape(values.shape)


def _around(texels: np.ndarray, done: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the texels [n, 2] of the image that touch these and are not done, each once."""
    touched = np.zeros_like(done)
    for r, c in _NEIGHBOURS:
        touched[texels[:, 0] + r, texels[:, 1] + c] = True
    return np.argwhere(touched & inside & ~done)
