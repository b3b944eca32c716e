"""Exports maps.exr or depth.exr as a USD asset."""

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import export_metadata
from service.requests.export import ExportRequest, Geometry
from service.usd.asset import write_asset
from service.usd.depth_asset import write_depth_mesh, write_depth_points
from stage.depth_maps import DEPTH_FILE, DepthMaps
from stage.errors import ResultError
from stage.fingerprint import digest
from stage.maps import MAPS_FILE, SurfaceMaps
from stage.ply import POINTS_FILE, PointCloud, read_ply


class Exported(NamedTuple):
    """An asset and what its user should know of it."""

    path: Path
    warnings: tuple[str, ...]
    """Sentences."""


def export(request: ExportRequest, progress: Progress | None = None) -> Exported:
    """Write a USD asset from solved maps, or from a depth where there are no maps.

    Raises:
        ResultError: the maps are missing or incomplete.
        RequestError: a geometry is asked for solved maps.
        AssetError: an unknown suffix, no height, or no face.
        StorageError: the asset cannot be written; nothing is left half-written.
    """
    timings = Timings(progress)
    timings.stage("read", 1)
    warnings: list[str] = []
    path = request.maps / MAPS_FILE if request.maps.is_dir() else request.maps
    depth = request.maps / DEPTH_FILE if request.maps.is_dir() else request.maps
    of_depth = depth.name == DEPTH_FILE and depth.exists() and (request.geometry is not None or not path.exists() or path == depth)
    if not of_depth and not path.exists():
        raise ResultError(f"{path}: is not there: run `relit solve` or `relit depth` first")
    if of_depth:
        _export_depth(depth, request, timings)
    else:
        if request.geometry is not None:
            raise RequestError(f"--geometry {request.geometry}: is for a depth, {path} holds solved maps: they become a mesh")
        maps = SurfaceMaps.read(path)
        maps = replace(maps, provenance={**maps.provenance, **export_metadata(request, {path.stem: digest(path)})})
        timings.stage("asset", 1)
        report = write_asset(maps, request.out, name=_name(request, maps.provenance.get("relit:capture")), version=request.version)
        warnings += [f"{layer}: {count} pixels have a value outside 0…1, which the texture cannot hold: they are clipped"
                     for layer, count in report.clipped_pixels.items() if count]
    timings.close()
    return Exported(request.out, tuple(warnings))


def _export_depth(path: Path, request: ExportRequest, timings: Timings) -> None:
    maps = DepthMaps.read(path)
    beside = path.parent / POINTS_FILE
    cloud: PointCloud | None = read_ply(beside) if beside.exists() else None
    contents = {file.stem: digest(file) for file in (path, beside) if file.exists()}
    maps = replace(maps, provenance={**maps.provenance, **export_metadata(request, contents)})
    timings.stage("asset", 1)
    write = write_depth_points if request.geometry is Geometry.POINTS else write_depth_mesh
    write(maps, cloud, request.out, name=_name(request, maps.provenance.get("relit:capture")), version=request.version)


def _name(request: ExportRequest, capture: str | None) -> str:
    return request.name or capture or re.sub(r"\..*", "", request.out.name)
