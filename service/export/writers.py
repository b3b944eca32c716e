"""The formats that meshes are written in.

To add one, write the functions that its field here names, put a Writer of them into WRITERS under its suffixes, and where `relit export`
writes it, its suffix into AssetFormat of service/requests/export.py and its media type into FORMATS there.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from service.asset.content.surface import AssetReport, Inspection
from service.asset.gltf import asset as gltf
from service.asset.gltf.inspect import inspect_glb
from service.asset.usd import asset as usd
from service.asset.usd.depth_asset import write_depth
from service.asset.usd.fused_asset import write_fused
from service.asset.usd.inspect import inspect_usd
from service.errors import AssetError
from stage.results.mesh import write_mesh_ply


def _refuse(*given: Any, **options: Any) -> NoReturn:
    raise AssetError("this format has no place for such a mesh")


class Writer(NamedTuple):
    """The functions that write files of a format, whole or not at all, and read them back; one that is left out refuses."""

    surface: Callable[..., AssetReport] = _refuse
    """(SurfaceMaps, path, *, name, version, textures, progress): solved maps with their material and camera."""
    depth: Callable[..., tuple[str, ...]] = _refuse
    """(DepthMaps, PointCloud | None, path, *, name, geometry, version, textures, progress): a depth; returns sentences on what the
    asset lacks."""
    fused: Callable[..., None] = _refuse
    """(UnwrappedMesh, BakedImages, path, *, name, provenance, progress): a fused surface with textures."""
    mesh: Callable[..., None] = _refuse
    """(TriangleMesh, path, *, comments): a fused surface, or a tile of one, with colours and other values at its vertices."""
    inspect: Callable[[Path], Inspection] | None = None
    """What a file holds, and what is wrong with it; None: `relit inspect` does not read the format."""
    variants: bool = False
    """True if `surface` takes levels and surroundings too: levels of detail, lights, an environment and relit frames."""


USD = Writer(usd.write_asset, write_depth, write_fused, inspect=inspect_usd, variants=True)
GLTF = Writer(gltf.write_asset, gltf.write_depth, inspect=inspect_glb)
PLY = Writer(mesh=write_mesh_ply)
WRITERS = {".usda": USD, ".usdc": USD, ".usdz": USD, ".glb": GLTF, ".ply": PLY}
"""The writers by the suffix of the file."""
INSPECTED = {suffix: writer.inspect for suffix, writer in (*WRITERS.items(), (".usd", USD)) if writer.inspect is not None}
"""The functions of `relit inspect` by the suffix of the file: a .usd is read, and never written, because it may be either kind of layer."""
