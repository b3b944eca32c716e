"""The layers of frames that stay the same under any light: matte, mask, and what the solved maps say about the surface."""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.errors import RequestError
from service.requests.light.picture_options import FrameCompression, FrameMatte, FrameParts, Layer, PictureOptions
from stage.capture.capture import Capture, check_same_pixels
from stage.colour.colour import rgb_matrix
from stage.errors import ResultError
from stage.results.maps import MAPS_FILE, SurfaceMaps
from stage.results.matte import Matte, MatteSource, matte_of
from stage.results.result_metadata import result_file
from stage.stack.stack import Stack


class Content(NamedTuple):
    """The content of a layer, and the names of its channels."""

    name: str
    """The name of the layer in the file."""
    suffixes: str
    """The channels, of one letter each."""
    map: str
    """The layer of maps.exr that it is made from."""
    dtype: type[np.floating[Any]] = np.float16
    is_colour: bool = False


STILL = {
    Layer.MASK: Content("mask", "Y", "mask"),
    Layer.NORMAL: Content("normal", "XYZ", "normal"),
    Layer.WORLD_NORMAL: Content("N", "XYZ", "normal"),
    Layer.POSITION: Content("P", "XYZ", "height", np.float32),
    Layer.DEPTH: Content("depth", "Z", "height", np.float32),
    Layer.ALBEDO: Content("albedo", "RGB", "diffuse_albedo", is_colour=True),
    Layer.CONFIDENCE: Content("confidence", "Y", "confidence"),
}
"""The layers that stay the same under any light, named as in maps.exr or as other programs do: N and P (Arnold), depth.Z (Nuke)."""
NEED_MAPS = (*(layer for layer in STILL if layer is not Layer.MASK), Layer.DIFFUSE, Layer.SPECULAR)


class StillLayer(NamedTuple):
    """A layer that every frame of a capture shares."""

    name: str
    channels: dict[str, np.ndarray]  # each [rows, cols] float16 or float32
    is_colour: bool
    """True if the channels are colours in the colour space of the frames; else they are data."""

    def rows(self, first: int, last: int) -> "StillLayer":
        """Return the rows from `first` until before `last`."""
        return self._replace(channels={name: plane[first:last] for name, plane in self.channels.items()})


def check_layers(options: PictureOptions, maps: Path | None) -> None:
    """Refuse layers that need maps where none are given, and layers of data that a lossy compression would change."""
    for layer in options.aov:
        if layer in NEED_MAPS and maps is None:
            raise RequestError(f"--aov {layer} needs --maps DIR")
        if layer in STILL and options.compression is FrameCompression.DWAA and options.parts is FrameParts.SINGLE:
            raise RequestError(f"--parts single: --compression dwaa would change the layer {layer}: leave --parts out, or choose zip")


def in_parts(options: PictureOptions) -> bool:
    """Return whether the layers of a frame lie in parts of their own."""
    if options.parts is not None:
        return options.parts is FrameParts.MULTI
    return options.compression is FrameCompression.DWAA and any(layer in STILL for layer in options.aov)


def frame_matte(options: PictureOptions, capture: Capture, stack: Stack) -> Matte | None:
    """Return the matte of the frames of a capture, or None where none is wanted."""
    if options.matte is FrameMatte.NONE:
        return None
    return matte_of(capture, stack) if options.matte is FrameMatte.SOFT else hard_matte(capture.mask())


def hard_matte(mask: np.ndarray) -> Matte:
    """Return the matte of a mask [rows, cols] bool whose pixels are wholly covered."""
    coverage = mask.astype(np.float32)
    return Matte(coverage, coverage, MatteSource.MASK, 0.0)


def maps_file(folder: Path, capture: Path, captures: int) -> Path:
    """Return the file of a capture's maps, which must be there: given as itself or by its folder, for a sequence in the sub-folder of the
    capture's name."""
    return result_file(folder / capture.name if captures > 1 else folder, MAPS_FILE, command="relit solve")


def read_maps(path: Path, capture: Capture) -> SurfaceMaps:
    """Read the solved maps of a capture, which must be of its size."""
    maps = SurfaceMaps.read(path)
    check_same_pixels(path, maps.camera, capture)
    return maps


def still_layers(layers: Collection[Layer], capture: Capture | None, maps: SurfaceMaps | None, where: Path | None,
                 space: str) -> tuple[StillLayer, ...]:
    """Return the layers that every frame of a capture shares, in the order of STILL; pixels that are not solved are 0.
    `layers`: the wanted layers; those that depend on the light are passed over. `capture`: gives the mask where there are no maps.
    `maps, where`: solved maps and their file, or None. `space`: the scene-linear colour space of the frames."""
    found = []
    for layer, content in STILL.items():
        if layer not in layers:
            continue
        values = getattr(maps, content.map) if maps is not None else capture.mask() if capture is not None else None
        if values is None:
            raise ResultError(f"{where}: has no layer {content.map}, which --aov {layer} needs")
        if maps is not None and layer in DERIVED:
            values = np.where(maps.mask[..., None], DERIVED[layer](maps, space), 0)
        planes = values[..., None] if values.ndim == 2 else values
        channels = {f"{content.name}.{suffix}": planes[..., c].astype(content.dtype) for c, suffix in enumerate(content.suffixes)}
        found.append(StillLayer(content.name, channels, content.is_colour))
    return tuple(found)


def _world_normal(maps: SurfaceMaps, _: str) -> np.ndarray:
    assert maps.normal is not None
    return maps.normal @ maps.camera.pose[:3, :3].T


def _position(maps: SurfaceMaps, _: str) -> np.ndarray:
    assert maps.height is not None
    pose = maps.camera.pose
    return maps.camera.points(maps.height) @ pose[:3, :3].T + pose[:3, 3]


def _depth(maps: SurfaceMaps, _: str) -> np.ndarray:
    assert maps.height is not None
    return -maps.height[..., None]


def _albedo(maps: SurfaceMaps, space: str) -> np.ndarray:
    assert maps.diffuse_albedo is not None
    return maps.diffuse_albedo @ rgb_matrix(maps.color_space, space).T if space != maps.color_space else maps.diffuse_albedo


DERIVED: dict[Layer, Callable[[SurfaceMaps, str], np.ndarray]] = {
    Layer.WORLD_NORMAL: _world_normal, Layer.POSITION: _position, Layer.DEPTH: _depth, Layer.ALBEDO: _albedo,
}
"""Functions that make layers [rows, cols, channels] from the maps and the colour space of the frames."""
