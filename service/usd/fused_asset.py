"""Writes a fused surface as a USD asset: a mesh in the world frame with baked textures and a material."""

from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from service.asset.metallic import IOR_LIMITS, metallic_look
from service.asset.openpbr import openpbr_document, write_openpbr
from service.asset.textures import BakedImages, write_textures
from service.asset.unwrap import UnwrappedMesh
from service.requests.export import TextureFormat
from service.usd.files import check_textures, install, temporary_folder_beside
from service.usd.layers import AssetLayers, Description, texture_folder
from service.usd.materials import define_looks
from service.usd.scene import define_polygons
from service.usd.surroundings import files_of_assets


def write_fused(unwrapped: UnwrappedMesh, baked: BakedImages, path: Path, *, name: str, provenance: dict[str, str]) -> None:
    """Write a fused surface as a USD asset.

    Args:
        unwrapped: in the world frame, metres.
        baked: the images over its texture.
        path: .usda, .usdc or .usdz.
        name: free text; the root prim is named after it.
        provenance: kept with the asset.

    Raises:
        AssetError: another suffix.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    mesh, maps = unwrapped.mesh, baked.maps
    packed = check_textures(path, TextureFormat.PNG16) == ".usdz"
    look = metallic_look(maps) if maps.diffuse_albedo is not None else None
    with temporary_folder_beside(path) as temporary:
        folder = temporary / texture_folder(path)
        folder.mkdir()
        textures = write_textures(maps, mesh, folder, look=look, tangent=baked.normal)
        ior = look.ior if look is not None else IOR_LIMITS[0]
        beside = [folder / texture.file_name for texture in textures.values()]
        openpbr = openpbr_document(textures, ior=ior) if look is not None else None
        if openpbr is not None and not packed:
            beside.append(write_openpbr(openpbr, folder))
        layers = AssetLayers(temporary, path, Description(name, None, provenance))
        with layers.geometry_variant("mesh") as geom:
            layers.add_surface(_define_mesh(layers.geometry, geom.AppendChild("Mesh"), unwrapped).GetPath())
        UsdGeom.Scope.Define(layers.materials, layers.looks)
        define_looks(layers, textures, ior=ior, openpbr=openpbr)
        layers.save()
        first, *others = layers.files
        install(path, first, [*others, *beside], ours=files_of_assets(path))


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
