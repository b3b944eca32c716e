"""Writes a fused surface in USD: a mesh in the world frame with baked textures, or many tiles.

The tiles are payloads of a small layer, so that a viewer loads those that it shows.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, Vt

from service.asset.content.metallic import metallic_look
from service.asset.content.textures import BakedImages, write_textures
from service.asset.content.uv_unwrap import UnwrappedMesh
from service.asset.usd.files import write_layer
from service.asset.usd.layers import Description, define_root, prim_name
from service.asset.usd.materials import define_openpbr_looks
from service.asset.usd.scene import define_polygons
from service.asset.usd.surroundings import writing_asset
from service.reporting.progress import Progress
from stage.colour.colour import convert
from stage.results.mesh import TriangleMesh


def write_fused(unwrapped: UnwrappedMesh, baked: BakedImages, path: Path, *, name: str, provenance: dict[str, str],
                progress: Progress | None = None) -> None:
    """Write a fused surface in the world frame, with the images over its texture, as a USD asset.
    Raises AssetError for another suffix. Raises StorageError if the disk refuses; what was there before is left as it was."""
    maps = baked.maps
    look = metallic_look(maps) if maps.diffuse_albedo is not None else None
    with writing_asset(path, Description(name, None, provenance)) as files:
        layers = files.layers
        textures = write_textures(maps, unwrapped.mesh, files.textures, look=look, tangent=baked.normal, progress=progress)
        with layers.geometry_variant("mesh") as geom:
            layers.add_surface(_define_mesh(layers.geometry, geom.AppendChild("Mesh"), unwrapped).GetPath())
        files.beside.extend(define_openpbr_looks(layers, files.textures, textures, look))


def _define_mesh(usd_stage: Usd.Stage, path: Sdf.Path, unwrapped: UnwrappedMesh) -> UsdGeom.Mesh:
    """Define the polygons, with one point for each place and texture coordinates for each corner."""
    mesh, place = unwrapped
    first = np.unique(place, return_index=True)[1]
    usd_mesh = define_polygons(usd_stage, path, mesh.points[first], mesh.normals[first], mesh.face_counts, place[mesh.face_indices])
    values, index = np.unique(mesh.st, axis=0, return_inverse=True)
    coordinates = UsdGeom.PrimvarsAPI(usd_mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(values)))
    coordinates.SetIndices(Vt.IntArray.FromNumpy(index.ravel()[mesh.face_indices].astype(np.int32)))
    return usd_mesh


SITE_FILE = "site.usda"
TILE = "Tile"
"""The root prim of the layer of a tile."""


class Tile(NamedTuple):
    """A tile that was written."""

    path: Path
    low: np.ndarray  # [3] metres
    high: np.ndarray


def write_tile(mesh: TriangleMesh, path: Path) -> Tile:
    """Write a mesh with the colours of its vertices as a layer, whole or not at all."""
    def define(usd_stage: Usd.Stage) -> None:
        root = define_root(usd_stage, Sdf.Path(f"/{TILE}"))
        counts = np.full(len(mesh.faces), 3, dtype=np.int32)
        usd_mesh = define_polygons(usd_stage, root.GetPath().AppendChild("Mesh"), mesh.points, mesh.normals, counts, mesh.faces.ravel())
        if mesh.colours is not None:
            linear = convert((mesh.colours[None] / 255).astype(np.float32), "srgb_rec709_scene", "lin_rec709_scene")[0]
            colours = usd_mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
            colours.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(linear, dtype=np.float32)))

    write_layer(path, define)
    return Tile(path, mesh.points.min(axis=0), mesh.points.max(axis=0))


def write_site(tiles: Sequence[Tile], path: Path, *, name: str, provenance: dict[str, str]) -> None:
    """Write the layer that has tiles as payloads, with the extent of each, so that a viewer knows it before it loads the tile."""
    def define(usd_stage: Usd.Stage) -> None:
        usd_stage.SetLoadRules(Usd.StageLoadRules.LoadNone())  # the layer is written in another folder first, where the tiles are not
        usd_stage.GetRootLayer().customLayerData = dict(provenance)
        root = define_root(usd_stage, Sdf.Path(f"/{prim_name(name)}"))
        Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.assembly)
        for tile in tiles:
            place = root.GetPath().AppendChild("tile_" + tile.path.stem.replace("-", "m"))
            prim = UsdGeom.Xform.Define(usd_stage, place).GetPrim()
            Usd.ModelAPI(prim).SetKind(Kind.Tokens.component)
            prim.GetPayloads().AddPayload(f"./{tile.path.relative_to(path.parent).as_posix()}")
            UsdGeom.ModelAPI.Apply(prim).SetExtentsHint(Vt.Vec3fArray([Gf.Vec3f(*map(float, tile.low)), Gf.Vec3f(*map(float, tile.high))]))

    write_layer(path, define)


def remove_other_tiles(folder: Path, tiles: Sequence[Tile]) -> None:
    """Delete the tiles of an earlier fusion that this one does not have."""
    kept = {tile.path.stem for tile in tiles}
    for path in folder.iterdir():
        if path.suffix in (".usdc", ".ply") and path.stem not in kept and path.stem.replace("-", "").replace("_", "").isdecimal():
            path.unlink(missing_ok=True)
