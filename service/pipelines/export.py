"""maps.exr → a USD asset."""

import re
from pathlib import Path

from service.progress import Progress, Timings
from service.requests import ExportRequest
from service.usd.asset import write_asset
from stage.errors import ResultError
from stage.maps import MAPS_FILE, SurfaceMaps


def export(request: ExportRequest, progress: Progress | None = None) -> Path:
    """Write a USD asset from solved maps.

    Returns:
        The path of the asset.

    Raises:
        ResultError: the maps are missing or incomplete.
        AssetError: an unknown suffix, no height, or no face.
        StorageError: the asset cannot be written; nothing is left half-written.
    """
    timings = Timings(progress)
    timings.stage("read", 1)
    path = request.maps / MAPS_FILE if request.maps.is_dir() else request.maps
    if not path.exists():
        raise ResultError(f"{path}: is not there: run `relit solve` first")
    maps = SurfaceMaps.read(path)
    timings.stage("asset", 1)
    name = request.name or maps.provenance.get("relit:capture") or re.sub(r"\..*", "", request.out.name)
    write_asset(maps, request.out, name=name)
    timings.close()
    return request.out
