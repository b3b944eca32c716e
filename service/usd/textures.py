"""Texture images of an asset: 8-bit sRGB PNG for colours, 16-bit raw PNG for normals and roughness.

PNG is what every reader of a USDZ package must know. Values outside 0…1 cannot be kept in it: they are clipped, and
counted.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio

from service.usd.bleed import bleed
from service.usd.errors import AssetError
from service.usd.mesh import SurfaceMesh
from service.usd.tangent import tangent_frame
from stage.maps import SurfaceMaps

DISPLAY_SPACE = "srgb_rec709_scene"
"""What UsdUVTexture means by sourceColorSpace sRGB: Rec.709 primaries, the sRGB curve."""

BLEED_TEXELS = 8
"""How far colour is bled over the edge of the mask: bilinear filtering stays clean down to the third mip level."""

LAYERS = ("diffuse_albedo", "normal", "specular", "roughness")
"""Layers that a material uses, in the order they are written."""

FILE_NAMES = tuple(f"{layer}.png" for layer in LAYERS)
"""Every file that write_textures can write."""


class Texture(NamedTuple):
    """One written image, and how a material has to read it."""

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
            encoded, known = _tangent_space(values, known, mesh)
            write(layer, encoded, known, np.uint16)
        elif layer == "roughness":
            write(layer, values, known, np.uint16)
        else:
            write(layer, _to_display(np.where(known[..., None], values, 0), maps.color_space), known, np.uint8)
    return written


def quantise(values: np.ndarray, known: np.ndarray, dtype: type[np.unsignedinteger]) -> tuple[np.ndarray, int]:
    """Round 0…1 to the codes of an integer type.

    Returns:
        codes, as values; and the number of known pixels with a channel more than half a code outside 0…1.
    """
    top = float(np.iinfo(dtype).max)
    codes = np.floor(values * top + 0.5)
    outside = (codes < 0) | (codes > top)
    clipped = outside if outside.ndim == 2 else outside.any(axis=-1)
    return np.clip(codes, 0, top).astype(dtype), int(np.count_nonzero(clipped & known))


def write_png(path: Path, codes: np.ndarray, *, srgb: bool) -> None:
    """Write a PNG of one or three channels, uint8 or uint16.

    Raises:
        OSError: the file cannot be written.
    """
    pixels = np.ascontiguousarray(codes[..., None] if codes.ndim == 2 else codes)  # two dimensions would be transposed
    rows, cols, channels = pixels.shape
    spec = oiio.ImageSpec(cols, rows, channels, str(codes.dtype))
    spec.attribute("oiio:ColorSpace", DISPLAY_SPACE if srgb else "data")  # without it the file would claim to be sRGB
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise OSError(f"texture {path.name}: {oiio.geterror()}")
    if not (output.open(str(path), spec) and output.write_image(pixels) and output.close()):
        raise OSError(f"texture {path.name}: {output.geterror() or 'the PNG writer gave up'}")
    if not _is_whole(path):  # the writer reports success when the disk is full
        raise OSError(f"texture {path.name}: the disk took only part of it")


def _is_whole(path: Path) -> bool:
    """Whether the chunks of a PNG follow each other up to its end chunk, and the file ends there."""
    size, at = path.stat().st_size, len(b"\x89PNG\r\n\x1a\n")
    with open(path, "rb") as stream:
        while at < size:
            stream.seek(at)
            length, kind = struct.unpack(">I4s", stream.read(8).ljust(8, b"\0"))
            at += 8 + length + 4  # length and kind, data, checksum
            if kind == b"IEND":
                break
        else:
            return False
    return at == size


def _to_display(values: np.ndarray, color_space: str) -> np.ndarray:
    """Colours [rows, cols, 3] of the maps, encoded for the screen; not clipped."""
    converted = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(np.ascontiguousarray(values)), color_space, DISPLAY_SPACE,
                                               colorconfig="ocio://default")
    if converted.has_error:
        raise AssetError(f"the colour space {color_space} of the maps cannot be converted to {DISPLAY_SPACE}: name one "
                         "that OpenColorIO's default configuration knows")
    return np.asarray(converted.get_pixels(oiio.FLOAT))


def _tangent_space(normal: np.ndarray, known: np.ndarray, mesh: SurfaceMesh) -> tuple[np.ndarray, np.ndarray]:
    """Normals [rows, cols, 3] as 0…1 in the tangent space of the mesh, and where they are known."""
    frame = tangent_frame(mesh, known.shape)
    length = np.linalg.norm(np.where(known[..., None], normal, 0), axis=-1)
    known = known & frame.covered & (length > 0)
    unit = np.where(known[..., None], normal, 0) / np.where(known, length, 1)[..., None]
    return frame.express(unit) / 2 + 0.5, known
