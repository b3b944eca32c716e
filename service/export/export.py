"""Exports maps.exr or depth.exr as a USD or glTF asset."""

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

from service.asset.errors import AssetError
from service.asset.repair import repair_heights
from service.errors import RequestError
from service.export.sequence import export_sequence, is_result_sequence
from service.export.surroundings import content_hashes, open_surroundings, refuse_surroundings
from service.gltf.asset import AssetReport as InGltf
from service.gltf.asset import write_asset as write_gltf_asset
from service.gltf.depth_asset import write_depth as write_gltf_depth
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import export_metadata
from service.requests.export import AssetFormat, ExportRequest, Geometry
from service.usd.asset import AssetReport as InUsd
from service.usd.asset import write_asset as write_usd_asset
from service.usd.depth_asset import write_depth as write_usd_depth
from stage.depth_maps import DEPTH_FILE, DepthMaps
from stage.errors import ResultError
from stage.fingerprint import digest
from stage.maps import MAPS_FILE, SurfaceMaps
from stage.ply import POINTS_FILE, PointCloud, read_ply
from stage.radiance import clipping_sentences

GLB = ".glb"


EXPORTED_LAYERS = ("normal", "diffuse_albedo", "specular", "roughness", "regime", "height", "part")
"""What an asset is made of, which is half of what `svbrdf` writes: at 4096 by 4096 pixels the rest takes 0.6 GiB."""


class Exported(NamedTuple):
    """An asset and what its user should know of it."""

    path: Path
    warnings: tuple[str, ...]
    """Sentences."""
    sizes: dict[str, tuple[int, int]]
    """Vertices and faces of each mesh by its name; empty for a depth."""
    lights: tuple[Path, ...] = ()
    """Layers of lights beside the asset."""


def export(request: ExportRequest, progress: Progress | None = None) -> Exported:
    """Write an asset from solved maps, or from a depth where there are no maps.

    Raises:
        ResultError: the maps are missing or incomplete.
        RequestError: a geometry is asked for solved maps, or levels of detail, lights or frames of a depth or in a .glb.
        ManifestError, ImageError: the capture of the rig, the environment or the frames of the card cannot be used.
        AssetError: an unknown suffix, EXR textures in a .usdz or .glb, no height, a height that
            contradicts its normals, or no face.
        StorageError: the asset cannot be written; nothing is left half-written.
    """
    suffix = _check_suffix(request.out)
    timings = Timings(progress)
    if is_result_sequence(request.maps):
        written, told = export_sequence(request, timings)
        timings.close()
        return Exported(request.out, told, {f"{written.steps} steps": (written.vertices, written.faces)})
    timings.stage("read", 1)
    warnings: list[str] = []
    sizes: dict[str, tuple[int, int]] = {}
    lights: tuple[Path, ...] = ()
    path = request.maps / MAPS_FILE if request.maps.is_dir() else request.maps
    depth = request.maps / DEPTH_FILE if request.maps.is_dir() else request.maps
    of_depth = depth.name == DEPTH_FILE and depth.exists() and (request.geometry is not None or not path.exists() or path == depth)
    if not of_depth and not path.exists():
        raise ResultError(f"{path}: is not there: run `relit solve` or `relit depth` first")
    if of_depth or suffix == GLB:
        refuse_surroundings(request)
    if of_depth:
        if request.levels:
            raise RequestError(f"--levels {request.levels}: is for solved maps, {depth} holds a depth: leave the option out")
        warnings += _export_depth(depth, request, suffix, timings)
    else:
        if request.geometry is not None:
            raise RequestError(f"--geometry {request.geometry}: is for a depth, {path} holds solved maps: they become a mesh")
        if suffix == GLB and request.levels:
            raise RequestError(f"--levels {request.levels}: a .glb holds one mesh: name a .usdz, .usda or .usdc, or leave the option out")
        maps = SurfaceMaps.read(path, layers=EXPORTED_LAYERS)
        around = open_surroundings(request, maps.camera)
        contents = {path.stem: digest(path), **content_hashes(around)}
        maps = replace(maps, provenance={**maps.provenance, **export_metadata(request, contents)})
        timings.stage("asset", 1)
        maps, _, repairs = repair_heights(maps)
        warnings += repairs
        name = _name(request, maps.provenance.get("relit:capture"))
        if suffix == GLB:
            report: InGltf | InUsd = write_gltf_asset(maps, request.out, name=name, version=request.version, textures=request.textures)
        else:
            report = write_usd_asset(maps, request.out, name=name, version=request.version, textures=request.textures,
                                     levels=request.levels, surroundings=around)
            lights = report.lights
            warnings += clipping_sentences({**(around.clipped or {}), **(around.rig.clipped if around.rig is not None else {})})
        sizes = report.sizes
        warnings += report.warnings
        if maps.diffuse_albedo is None:
            warnings.append("the maps have no diffuse_albedo, so the asset is grey: solve with a method that gives it")
        warnings += [f"{layer}: {count} pixels have a value outside 0…1, which the texture cannot hold: they are clipped"
                     for layer, count in report.clipped_pixels.items() if count]
    timings.close()
    return Exported(request.out, tuple(warnings), sizes, lights)


def _check_suffix(target: Path) -> str:
    """Return the suffix of an asset in lower case."""
    suffix = target.suffix.lower()
    if suffix.removeprefix(".") not in get_args(AssetFormat):
        raise AssetError(f"{target} cannot be written as an asset: its suffix must be .usda, .usdc or .usdz for USD, or .glb for glTF")
    return suffix


def _export_depth(path: Path, request: ExportRequest, suffix: str, timings: Timings) -> tuple[str, ...]:
    """Write an asset of a depth, and return what its user should know of it."""
    maps = DepthMaps.read(path)
    beside = path.parent / POINTS_FILE
    cloud: PointCloud | None = read_ply(beside) if beside.exists() else None
    contents = {file.stem: digest(file) for file in (path, beside) if file.exists()}
    maps = replace(maps, provenance={**maps.provenance, **export_metadata(request, contents)})
    timings.stage("asset", 1)
    write = write_gltf_depth if suffix == GLB else write_usd_depth
    return write(maps, cloud, request.out, name=_name(request, maps.provenance.get("relit:capture")),
                 geometry=request.geometry or Geometry.MESH, version=request.version, textures=request.textures)


def _name(request: ExportRequest, capture: str | None) -> str:
    return request.name or capture or re.sub(r"\..*", "", request.out.name)
