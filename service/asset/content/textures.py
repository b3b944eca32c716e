"""Texture images of an asset: what its materials read, in PNG of 16 bits, PNG of 8 bits, or half EXR.

Colours of a PNG are Rec.709 with the sRGB curve, because clients know that and raw data and nothing else; what lies outside 0…1 is clipped
there, and counted. Colours of an EXR are scene-linear in the colour space of the maps. The other images are data.

Source: OpenUSD, "UsdPreviewSurface Specification", texture reader (sourceColorSpace); USDZ File Format Specification (kinds of images).
"""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.asset.content.mesh import SurfaceMesh
from service.asset.content.metallic import MetallicLook
from service.asset.content.tangent import TangentFrames
from service.errors import AssetError
from service.reporting.progress import Progress, Timings
from service.requests.export import TextureFormat
from stage.colour.colour import convert
from stage.colour.colour_spaces import linear_space
from stage.formats import exr
from stage.formats.images import write_png
from stage.results.maps import SurfaceMaps

DISPLAY_SPACE = "srgb_rec709_scene"
"""The space that UsdUVTexture calls sRGB in sourceColorSpace: Rec.709 primaries and the sRGB curve."""

DATA_SPACE = "data"
"""The colour space of images that are no colours."""

NEUTRAL_SPACE = "lin_rec709_scene"
"""The scene-linear space that readers take raw colours as."""

BLEED_TEXELS = 8
"""Distance in texels by which colour is bled over the edge of the mask: bilinear filtering stays clean down to the third mip level."""

BAND_ROWS = 256
"""Rows that are computed at a time: bounds the memory of single-precision copies; OpenColorIO needs 0.02 s for each call."""

IMAGES_AT_ONCE = 2
"""Images that are compressed side by side: each holds some 300 MB at 4096 by 4096 texels."""

VISIBLE = 0.5 / 255
"""The least distance outside 0…1 at which a value is called clipped: half a code of a display."""

COLOURS = ("base_color", "diffuse_albedo", "specular")
"""Images that hold colours."""

NAMES = ("base_color", "metallic", "roughness", "normal", "diffuse_albedo", "specular")
"""Every image, in the order they are written: the look `metallic` reads the first four, `specular` the last four."""

_NEIGHBOURS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]
_PNG_TYPES: dict[TextureFormat, type[np.unsignedinteger[Any]]] = {TextureFormat.PNG16: np.uint16, TextureFormat.PNG8: np.uint8}

FILE_NAMES = tuple(f"{name}.{suffix}" for name in NAMES for suffix in ("png", "exr"))
"""Every file that write_textures can write."""


class Texture(NamedTuple):
    """A written image, and how a material has to read it."""

    file_name: str
    color_space: str  # DISPLAY_SPACE, DATA_SPACE, or the scene-linear space of the maps
    clipped_pixels: int  # masked pixels with a channel that had to be cut to 0…1


class TangentNormals(NamedTuple):
    """Normals in the tangent space of a mesh, where the caller has them already."""

    values: np.ndarray  # [rows, cols, 3] float32, 0…1: (n + 1)/2
    known: np.ndarray  # [rows, cols] bool


class BakedImages(NamedTuple):
    """Images over the texture of a mesh whose vertices no pixel carries."""

    maps: SurfaceMaps  # colours and roughness; its camera is a placeholder with the size of the texture
    normal: TangentNormals
    seen_share: float  # of the covered texels that a scan shows


def write_textures(maps: SurfaceMaps, mesh: SurfaceMesh, folder: Path, *, look: MetallicLook | None = None,
                   storage: TextureFormat = TextureFormat.PNG16, tangent: TangentNormals | None = None,
                   progress: Progress | None = None) -> dict[str, Texture]:
    """Write the images that the materials of solved maps use, and return them by name, in the order of NAMES.

    Args:
        mesh: of these maps; the normal map is relative to its frame.
        look: of these maps, for `base_color` and `metallic`; an object without metal has no `metallic`.
        storage: 8 bits are kept for colours alone: normals and roughness would show their steps in highlights, and have 16.
        tangent: the normals in the tangent space of the mesh; None: those of the maps, whose pixels carry the vertices of the mesh.
    """
    sources: dict[str, np.ndarray | None] = {"roughness": maps.roughness, "normal": maps.normal if tangent is None else tangent.values}
    if look is not None:
        sources |= {"base_color": look.base_color, "metallic": look.metallic if look.metallic.any() else None}
    if maps.specular is not None or look is None:  # of a Lambertian surface the base colour is the albedo
        sources |= {"diffuse_albedo": maps.diffuse_albedo, "specular": maps.specular}
    reach = max(BLEED_TEXELS, mesh.step)

    def write(name: str, values: np.ndarray) -> Texture:
        known = maps.mask & np.isfinite(values if values.ndim == 2 else values.sum(axis=-1))
        if name == "normal" and tangent is not None:
            known = tangent.known
        if look is not None and name in ("base_color", "metallic"):
            known &= look.known
        space = DATA_SPACE if name not in COLOURS else linear_space(maps.color_space) if storage is TextureFormat.EXR else DISPLAY_SPACE
        if storage is TextureFormat.EXR:
            if name == "normal" and tangent is None:
                values, known = tangent_space(values, known, mesh)
            return _write_exr(folder / f"{name}.exr", values, known, space, reach)
        colour = name in COLOURS
        if name == "normal" and tangent is None:
            codes, known, clipped = encode_normals(values, known, mesh, np.uint16)
        else:
            codes, clipped = encode(values, known, maps.color_space if colour else None, _PNG_TYPES[storage] if colour else np.uint16)
        write_png(folder / f"{name}.png", bleed(codes, known, reach=reach, in_place=True), srgb=colour)
        return Texture(f"{name}.png", space, clipped)

    return side_by_side({name: partial(write, name, source) for name in NAMES if (source := sources.get(name)) is not None}, progress)


def side_by_side(writers: Mapping[str, Callable[[], Texture]], progress: Progress | None) -> dict[str, Texture]:
    """Call the writers of images by their names, IMAGES_AT_ONCE at a time, and return what they return: the stage "textures"."""
    timings = Timings(progress)
    timings.stage("textures", max(len(writers), 1))
    with ThreadPoolExecutor(IMAGES_AT_ONCE, thread_name_prefix="relit-textures") as pool:
        futures = {name: pool.submit(writer) for name, writer in writers.items()}
        try:
            for done, future in enumerate(as_completed(futures.values()), start=1):
                future.result()
                timings.advance(done)
            return {name: future.result() for name, future in futures.items()}
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def space_warnings(textures: Mapping[str, Texture]) -> Iterator[str]:
    """Yield which colours look wrong in readers that know less than the files declare."""
    for space in sorted({texture.color_space for texture in textures.values()} - {DISPLAY_SPACE, DATA_SPACE, NEUTRAL_SPACE}):
        yield (f"textures: their colours are {space}, which readers that know sourceColorSpace alone, such as Blender, take as "
               f"{NEUTRAL_SPACE}; the colours of png16 are read alike everywhere")


def encode(values: np.ndarray, known: np.ndarray, color_space: str | None,
           dtype: type[np.unsignedinteger[Any]]) -> tuple[np.ndarray, int]:
    """Return the codes of an image, 0 where nothing is known, and the count of clipped pixels; without a colour space it is data."""
    codes, clipped = np.zeros(values.shape, dtype=dtype), 0
    for start in range(0, len(values), BAND_ROWS):
        rows = slice(start, start + BAND_ROWS)
        inside = known[rows]
        band = np.where(inside if values.ndim == 2 else inside[..., None], values[rows], 0).astype(np.float32, copy=False)
        codes[rows], more = quantise(to_display(band, color_space) if color_space else band, inside, dtype)
        clipped += more
    return codes, clipped


def _write_exr(path: Path, values: np.ndarray, known: np.ndarray, color_space: str, reach: int) -> Texture:
    """Write an image as EXR with channels R, G and B, or Y; half, but normals float: half would turn them by 0.03°."""
    dtype = np.float32 if path.stem == "normal" else np.float16
    image = bleed(np.where(known if values.ndim == 2 else known[..., None], values, 0).astype(dtype), known, reach=reach)
    channels = {"Y": image} if image.ndim == 2 else {channel: image[..., c] for c, channel in enumerate("RGB")}
    exr.write(path, channels, color_space=color_space, metadata={})
    return Texture(path.name, color_space, 0)


def quantise(values: np.ndarray, known: np.ndarray, dtype: type[np.unsignedinteger]) -> tuple[np.ndarray, int]:
    """Return values of 0…1 rounded to the codes of an integer type, and how many known pixels have a channel more than VISIBLE outside."""
    top = float(np.iinfo(dtype).max)
    outside = (values < -VISIBLE) | (values > 1 + VISIBLE)
    clipped = outside if outside.ndim == 2 else outside.any(axis=-1)
    codes = np.floor(np.clip(values, 0, 1) * top + 0.5)
    return codes.astype(dtype), int(np.count_nonzero(clipped & known))


def to_display(values: np.ndarray, color_space: str) -> np.ndarray:
    """Return colours [rows, cols, 3] of the maps in the display space; not clipped."""
    try:
        return convert(np.ascontiguousarray(values), color_space, DISPLAY_SPACE)
    except ValueError as error:
        raise AssetError(f"the colour space {color_space} of the maps cannot be converted to {DISPLAY_SPACE}: name one "
                         "that OpenColorIO's default configuration knows") from error


def tangent_space(normal: np.ndarray, known: np.ndarray, mesh: SurfaceMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return normals [rows, cols, 3] as 0…1 in the tangent space of the mesh, and where they are known."""
    encoded, covered = np.empty(normal.shape, dtype=np.float32), np.empty_like(known)
    for rows, values, there in _tangent_bands(normal, known, mesh):
        encoded[rows], covered[rows] = values, there
    return encoded, covered


def encode_normals(normal: np.ndarray, known: np.ndarray, mesh: SurfaceMesh,
                   dtype: type[np.unsignedinteger[Any]]) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the codes [rows, cols, 3] of normals in the tangent space of the mesh, 0 where they are not known; where they are known; and
    the count of clipped pixels."""
    codes, covered, clipped = np.empty(normal.shape, dtype=dtype), np.empty_like(known), 0
    for rows, values, there in _tangent_bands(normal, known, mesh):
        codes[rows], more = quantise(np.where(there[..., None], values, 0), there, dtype)
        covered[rows], clipped = there, clipped + more
    return codes, covered, clipped


def _tangent_bands(normal: np.ndarray, known: np.ndarray, mesh: SurfaceMesh) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Yield rows, their normals as 0…1 in the tangent space of the mesh, and where these are known."""
    frames = TangentFrames(mesh, (known.shape[0], known.shape[1]))
    for start in range(0, len(known), BAND_ROWS):
        rows = slice(start, min(start + BAND_ROWS, len(known)))
        frame = frames.of_rows(rows.start, rows.stop)
        vectors = np.where(known[rows][..., None], normal[rows], 0)
        length = np.sqrt(np.vecdot(vectors, vectors))
        covered = known[rows] & frame.covered & (length > 0)
        unit = np.where(covered[..., None], vectors, 0) / np.where(covered, length, 1)[..., None]
        yield rows, frame.express(unit) / 2 + 0.5, covered


def bleed(
    values: np.ndarray,  # [rows, cols] or [rows, cols, channels], integers or floats; zero throughout when nothing is known
    known: np.ndarray, *,
    reach: int,  # number of rings; texels beyond get the mean of the known ones, for the coarse mip levels
    in_place: bool = False,  # whether `values` are changed
) -> np.ndarray:
    """Fill unknown texels from their known neighbours, ring by ring, so that filtering a texture does not darken its border."""
    filled = values[..., None] if values.ndim == 2 else values
    if not in_place:
        filled = filled.copy()
    rows, cols, channels = filled.shape
    done = np.pad(known, 1)
    inner = done[1:-1, 1:-1]
    for _ in range(reach):
        ring = np.argwhere(_dilated(done)[1:-1, 1:-1] & ~inner)
        if len(ring) == 0:
            break
        total = np.zeros((len(ring), channels), dtype=np.float32)
        count = np.zeros((len(ring), 1), dtype=np.float32)
        for r, c in _NEIGHBOURS:
            row, col = ring[:, 0] + r, ring[:, 1] + c
            given = done[row + 1, col + 1][:, None]
            total += np.where(given, filled[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)], 0)
            count += given
        filled[ring[:, 0], ring[:, 1]] = _as_type(total / count, filled.dtype)
        inner[ring[:, 0], ring[:, 1]] = True
    beyond = ~inner
    if beyond.any():
        mean = [filled[..., c].mean(where=known, dtype=np.float64) if known.any() else 0.0 for c in range(channels)]
        filled[beyond] = _as_type(np.array(mean), filled.dtype)
    return filled.reshape(values.shape)


def _as_type(values: np.ndarray, dtype: np.dtype[Any]) -> np.ndarray:
    """Return values as a type, rounded where it is one of integers."""
    return (np.floor(values + 0.5) if np.issubdtype(dtype, np.integer) else values).astype(dtype)


def _dilated(done: np.ndarray) -> np.ndarray:
    """Return where a texel or one of its eight neighbours is set; the array has a frame of one unset texel."""
    wide = done.copy()
    wide[:, 1:] |= done[:, :-1]
    wide[:, :-1] |= done[:, 1:]
    tall = wide.copy()
    tall[1:] |= wide[:-1]
    tall[:-1] |= wide[1:]
    return tall
