"""The options of `relit export`, `relit inspect` and `relit blender-extension`."""

from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from service.requests.base.base import Choice, Options, PixelOptions, Role, Spelling
from stage.model import Line

AssetFormat = Literal["usdz", "usda", "usdc", "glb"]


class FormatFacts(NamedTuple):
    """The facts of a file format of assets that all may ask for; service/export/writers.py has what writes and reads it."""

    media_type: str | None = None
    """Its type at the IANA, which downloads name; None: it has none."""
    time_sampled: bool = False
    """True if the steps of a sequence can be written into it one after another."""


FORMATS: dict[AssetFormat, FormatFacts] = {
    "usdz": FormatFacts("model/vnd.usdz+zip", time_sampled=True),
    "usda": FormatFacts("model/vnd.usda"),
    "usdc": FormatFacts(time_sampled=True),
    "glb": FormatFacts("model/gltf-binary"),
}
TIME_SAMPLED = [name for name, facts in FORMATS.items() if facts.time_sampled]
"""Formats of the asset of a sequence."""

FIRST_VERSION = "1"
"""Version of an asset that nobody gave one."""

MOST_LEVELS = 4
"""Levels of detail that an asset can have: the fourth has a 256th of the faces."""


class Geometry(Choice):
    """The geometry of an asset of a depth."""

    MESH = "mesh", "faces between neighbouring pixels of one surface"
    POINTS = "points", "the measured points"


class TextureFormat(Choice):
    """The file format of the textures of an asset."""

    PNG16 = "png16", "16 bits, which every client reads; colours as sRGB"
    PNG8 = "png8", "8 bits for colours, a fifth of the size; normals, roughness and metallic keep 16, but not in a .glb"
    EXR = "exr", "half floats in the capture's scene-linear colour space, for .usda and .usdc"


class ExportOptions(PixelOptions):
    """Name, version, geometry and textures of an asset."""

    name: Line | None = None
    """Name of the asset; None: the name that the maps have, else the stem of the file's name."""
    version: Annotated[Line, Field(min_length=1)] = FIRST_VERSION
    """Version of the asset, written into its assetInfo: what a pipeline counts, as in 3 or v003."""
    geometry: Geometry | None = None
    """The geometry of an asset of a depth (depth.exr in place of maps.exr); None: mesh."""
    textures: TextureFormat = TextureFormat.PNG16
    """How textures are stored."""
    levels: Annotated[int, Field(ge=0, le=MOST_LEVELS)] = 0
    """Levels of detail of a USD asset of solved maps, each with about a quarter of the faces of the one before: variants lod1, lod2 … of
    geo. With any, the normals of all meshes are smooth, and the normal map, which they share, holds the rest."""


class ExportRequest(ExportOptions):
    """A USD or glTF asset of solved maps with their material, or of a depth with its colours."""

    maps: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="DIR")]
    """Folder with maps.exr or depth.exr, or the file; or the results of a sequence, which become a .usdc or .usdz with time samples."""
    out: Annotated[Path, Role.FILE]
    """The asset: .usdz, .usda, .usdc or .glb (binary glTF)."""
    rig: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Capture that was solved: its lights come along as UsdLux lights whose intensities replay it, as a variant that is off. For .usdz,
    .usda and .usdc of solved maps."""
    environment: Annotated[Path | None, Role.INPUT] = None
    """Lat-long environment map, .exr or .hdr: it comes along as a DomeLight, as a variant that is off. For .usdz, .usda and .usdc of solved
    maps."""
    card: Annotated[Path | None, Role.INPUT, Spelling(metavar="FRAMES")] = None
    """Relit frames of the capture, such as frame.####.exr: they come along on a rectangle in the plane of the image, as a variant of the
    geometry. For .usdz, .usda and .usdc of solved maps."""


class BlenderExtensionRequest(Options):
    """Write the extension that brings Relit into Blender 4.2 and later; Blender's preferences install it from the file."""

    out: Annotated[Path, Role.FILE]
    """The extension: .zip."""


class InspectRequest(Options):
    """Say what an asset holds, and what is wrong with it: layers, variants, geometry, materials, textures, provenance, validators."""

    asset: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="ASSET")]
    """The asset: .usdz, .usda, .usdc, .usd or .glb."""
    as_json: Annotated[bool, Role.RUN, Spelling(flag="--json")] = False
    """Print JSON, with whole texts and every number."""
