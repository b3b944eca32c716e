"""The layers of frames that stay the same under any light: mask, normal and confidence, from the solved maps or the capture."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from service.errors import RequestError
from service.requests.picture import Layer
from stage.capture import Capture
from stage.errors import ResultError
from stage.maps import MAPS_FILE, SurfaceMaps

SUFFIXES = {Layer.MASK: "Y", Layer.NORMAL: "XYZ", Layer.CONFIDENCE: "Y"}
"""Channels of each layer, as in maps.exr."""
NEED_MAPS = (Layer.NORMAL, Layer.CONFIDENCE, Layer.DIFFUSE, Layer.SPECULAR)


def check_layers(layers: Collection[Layer], maps: Path | None) -> None:
    """Refuse layers that need maps where none are given.

    Raises:
        RequestError: names the layer.
    """
    for layer in layers:
        if layer in NEED_MAPS and maps is None:
            raise RequestError(f"--aov {layer} needs --maps DIR")


def maps_file(folder: Path, capture: Path, captures: int) -> Path:
    """Return the file of a capture's maps: in the folder, or for a sequence in its sub-folder of the capture's name.

    Raises:
        RequestError: they are not there.
    """
    path = (folder / capture.name if captures > 1 else folder) / MAPS_FILE
    if not path.is_file():
        raise RequestError(f"--maps {folder}: {path} is not there: run `relit solve` first")
    return path


def read_maps(path: Path, capture: Capture) -> SurfaceMaps:
    """Read the solved maps of a capture.

    Raises:
        ResultError: not a maps.exr, or of another size.
        ImageError: it cannot be read.
    """
    maps = SurfaceMaps.read(path)
    if maps.camera.resolution != capture.camera.resolution:
        theirs, ours = ("x".join(map(str, camera.resolution)) for camera in (maps.camera, capture.camera))
        raise ResultError(f"{path}: is {theirs}, the capture {ours}: these are not its maps")
    return maps


def still_layers(layers: Collection[Layer], capture: Capture | None, maps: SurfaceMaps | None, where: Path | None) -> dict[str, np.ndarray]:
    """Return the layers that every frame of a capture shares.

    Args:
        layers: the wanted layers; those that depend on the light are passed over.
        capture: gives the mask where there are no maps.
        maps: solved maps, or None.
        where: the file of the maps, for messages.

    Returns:
        Channel name → [rows, cols] float16.

    Raises:
        ResultError: the maps lack a layer.
        ImageError: the capture's mask is empty or unreadable.
    """
    channels: dict[str, np.ndarray] = {}
    for layer, suffixes in SUFFIXES.items():
        if layer not in layers:
            continue
        values = getattr(maps, layer) if maps is not None else capture.mask() if capture is not None else None
        if values is None:
            raise ResultError(f"{where}: has no layer {layer}, which --aov {layer} needs")
        planes = values[..., None] if values.ndim == 2 else values
        for c, suffix in enumerate(suffixes):
            channels[f"{layer}.{suffix}"] = planes[..., c].astype(np.float16)
    return channels
