"""Solved maps as an asset has them, whatever its format, and what a writer of assets reports."""

from pathlib import Path
from typing import NamedTuple

from service.asset.content.camera import unit_in_metres
from service.asset.content.mesh import SurfaceMesh, height_mesh
from service.asset.content.metallic import MetallicLook, metallic_look
from stage.results.maps import SurfaceMaps


class Surface(NamedTuple):
    """A solved surface with its metallic look."""

    mesh: SurfaceMesh
    look: MetallicLook | None  # None: the maps have no reflectance
    provenance: dict[str, str]
    unit_m: float  # metres of a unit of the mesh


class AssetReport(NamedTuple):
    """The files and the sizes of an asset, and what its user should know of it."""

    path: Path
    sizes: dict[str, tuple[int, int]]  # vertices and faces of each mesh by its name; that of the full one is mesh
    step: int  # every step-th pixel in both directions carries a vertex
    clipped_pixels: dict[str, int]  # texture → pixels that did not fit into 0…1
    warnings: tuple[str, ...]  # sentences
    textures: tuple[Path, ...] = ()  # files beside it, with the MaterialX document last; empty where the asset holds them
    lights: tuple[Path, ...] = ()  # layers beside it


def surface_of(maps: SurfaceMaps) -> Surface:
    """Return solved maps as a mesh with its look."""
    look = metallic_look(maps) if maps.diffuse_albedo is not None else None
    provenance = {**maps.provenance, "relit:color_space": maps.color_space, **(look.provenance if look is not None else {})}
    return Surface(height_mesh(maps), look, provenance, unit_in_metres(maps.camera))
