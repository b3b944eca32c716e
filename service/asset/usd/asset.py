"""Writes solved maps as a USD asset: a mesh with textures, a material and the camera, as .usda, .usdc or .usdz."""

from pathlib import Path

from service.asset.content.levels_of_detail import level_meshes, with_smooth_normals
from service.asset.content.metallic import loss_warnings
from service.asset.content.surface import SCALE_NOTE, AssetReport, surface_of
from service.asset.content.textures import space_warnings, write_textures
from service.asset.usd.files import check_textures
from service.asset.usd.layers import Description
from service.asset.usd.materials import define_openpbr_looks
from service.asset.usd.scene import define_cameras, define_mesh
from service.asset.usd.surroundings import Surroundings, define_surroundings, writing_asset
from service.errors import AssetError
from service.reporting.progress import Progress, Timings
from service.requests.export import FIRST_VERSION, TextureFormat
from stage.results.maps import SurfaceMaps

NOTHING = Surroundings()
"""No surroundings."""


def write_asset(maps: SurfaceMaps, path: str | Path, *, name: str, version: str = FIRST_VERSION,
                textures: TextureFormat = TextureFormat.PNG16, levels: int = 0, surroundings: Surroundings = NOTHING,
                progress: Progress | None = None) -> AssetReport:
    """Write solved maps as a USD asset in the camera frame.
    Raises AssetError for another suffix, EXR textures in a .usdz, lights of a .usdz beside a .usda or .usdc of its name, maps without a
    height layer or without a face, or a colour space that is not known. Raises StorageError if the disk refuses; what was there before is
    left as it was.

    Args:
        path: its suffix chooses the format. Beside a .usda and .usdc go the folders `<stem>_layers` and `<stem>_textures`; a .usda and a
            .usdc of one name share them.
        name: free text; the root prim is named after it.
        levels: of detail, at most.
        surroundings: lights and frames that the asset brings along.
    """
    target = Path(path)
    if check_textures(target, textures) == ".usdz" and (surroundings.rig is not None or surroundings.environment is not None):
        _check_lights_are_free(target)
    timings = Timings(progress)
    timings.stage("mesh", 1)
    mesh, look, provenance, unit_m = surface_of(maps)
    meshes = {"mesh": mesh}
    if levels:
        if maps.normal is not None:  # else there is no normal map to hold what smoothing takes away
            meshes["mesh"] = mesh = with_smooth_normals(mesh)
        meshes |= {f"lod{number}": level for number, level in enumerate(level_meshes(mesh, maps.camera, levels), start=1)}
    with writing_asset(target, Description(name, maps.camera, provenance, unit_m, version)) as files:
        layers = files.layers
        written = write_textures(maps, mesh, files.textures, look=look, storage=textures, progress=timings)
        timings.stage("write", 1)
        if not maps.camera.metric:
            layers.geometry.GetPrimAtPath(layers.root).SetCustomDataByKey("relit:scale", SCALE_NOTE)
        for variant, each in meshes.items():
            with layers.geometry_variant(variant) as geom:
                layers.add_surface(define_mesh(layers.geometry, geom.AppendChild(variant.capitalize()), each).GetPath())
        files.beside.extend(define_openpbr_looks(layers, files.textures, written, look))
        define_cameras(layers.geometry, layers.root, maps.camera, mesh.extent)
        clipped = define_surroundings(files, surroundings, maps.camera, mesh.extent)
    return AssetReport(
        target, {variant: (len(each.points), len(each.face_counts)) for variant, each in meshes.items()}, mesh.step,
        {**{name: texture.clipped_pixels for name, texture in written.items()}, **clipped},
        (*(loss_warnings(look) if look is not None else ()), *space_warnings(written)),
        () if layers.packed else tuple(target.parent / files.textures.name / file.name for file in files.beside),
        tuple(target.parent / layers.lights.name / file.name for file in layers.light_files))


def _check_lights_are_free(package: Path) -> None:
    """Refuse to write the lights of a package over those that another asset of its name refers to."""
    for suffix in (".usda", ".usdc"):
        other = package.with_suffix(suffix)
        if other.exists():
            raise AssetError(f"{package}: its lights would replace those of {other}: choose another name")
