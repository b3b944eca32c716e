"""The layers of maps.exr or depth.exr as they are stored, taken one at a time, and how each is shown."""

from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels.status import Status
from stage.capture.capture import Capture, check_same_pixels
from stage.errors import ResultError
from stage.formats import exr
from stage.results import depth_maps, maps
from stage.results.result_metadata import camera_and_provenance

VECTOR, COLOUR, SCALAR, CODES, MASK = "vector", "colour", "scalar", "codes", "mask"
"""Kinds of layers: unit vectors, scene-linear colours, quantities, whole numbers that stand for something, and the mask."""


class Appearance(NamedTuple):
    """The display of a layer."""

    title: str
    kind: str
    unit: str | None = None


SURFACE = {
    "normal": Appearance("Normals", VECTOR),
    "diffuse_albedo": Appearance("Diffuse albedo", COLOUR),
    "diffuse_albedo_sigma": Appearance("Standard deviation of the albedo", COLOUR),
    "specular": Appearance("Specular (F0)", COLOUR),
    "roughness": Appearance("Roughness", SCALAR),
    "height": Appearance("Height", SCALAR, "m"),
    "height_sigma": Appearance("Standard error of the height", SCALAR, "m"),
    "specular_normal": Appearance("Specular normals", VECTOR),
    "abundance": Appearance("Share of the first material", SCALAR),
    "first_specular": Appearance("First material: specular (F0)", COLOUR),
    "first_roughness": Appearance("First material: roughness", SCALAR),
    "second_specular": Appearance("Second material: specular (F0)", COLOUR),
    "second_roughness": Appearance("Second material: roughness", SCALAR),
    "regime": Appearance("Reflection regime", CODES),
    "part": Appearance("Parts", CODES),
    "sigma": Appearance("Standard error of the normal", SCALAR, "degrees"),
    "confidence": Appearance("Confidence", SCALAR),
    "status": Appearance("Status", CODES),
    "mask": Appearance("Mask", MASK),
}
"""The layers of maps.exr in the order in which a person looks at them."""
DEPTH = {
    "depth": Appearance("Depth", SCALAR, "m"),
    "range": Appearance("Range", SCALAR, "m"),
    "sigma": Appearance("Standard deviation of the depth", SCALAR, "m"),
    "projector_u": Appearance("Projector column", SCALAR, "px"),
    "projector_v": Appearance("Projector row", SCALAR, "px"),
    "sigma_u": Appearance("Standard deviation of the projector column", SCALAR, "px"),
    "sigma_v": Appearance("Standard deviation of the projector row", SCALAR, "px"),
    "amplitude": Appearance("Amplitude", SCALAR),
    "confidence": Appearance("Confidence", SCALAR),
    "status": Appearance("Status", CODES),
    "mask": Appearance("Mask", MASK),
}
"""The same of depth.exr."""
PIXELS = "px"
"""The unit of heights where the capture gives no scale."""


class ResultLayers:
    """A result file of a capture, open for its layers."""

    def __init__(self, path: Path, capture: Capture) -> None:
        """Read the header of a maps.exr or depth.exr; its layers are read when the first is asked for."""
        self.path = path
        header = exr.read_header(path)
        told = [name for name, (channel, _) in depth_maps.LAYERS.items()
                if name in ("depth", "projector_u", "projector_v") and channel in header.channels]
        self.of_depth = bool(told)
        self.has_depth = "depth" in told
        file_name = depth_maps.DEPTH_FILE if self.of_depth else maps.MAPS_FILE
        self.camera, self.provenance = camera_and_provenance(header.metadata, path, file_name=file_name)
        check_same_pixels(path, self.camera, capture)
        self._names = {}
        for name, channels in channels_of_layers(self.of_depth).items():
            lacking = [channel for channel in channels if channel not in header.channels]
            if lacking and (len(lacking) < len(channels) or name == "mask"):
                raise ResultError(f"{path}: has no channel {lacking[0]}")
            if not lacking:
                self._names[name] = channels

    @cached_property
    def _channels(self) -> dict[str, np.ndarray]:
        return exr.read(self.path)[0]

    def forget(self) -> None:
        """Forget all layers; the next one that is asked for is read from the file again."""
        self.__dict__.pop("_channels", None)

    @cached_property
    def mask(self) -> np.ndarray:
        """The pixels that count as solved, [rows, cols] bool."""
        return np.asarray(self.plane("mask") > 0.5)

    @cached_property
    def status(self) -> np.ndarray | None:
        """The status of each pixel, [rows, cols] uint8; None: the file has none."""
        if "status" not in self._names:
            return None
        codes = self.plane("status")
        if not np.isin(codes, list(Status)).all():
            raise ResultError(f"{self.path}: layer status holds codes that this version does not know: solve again")
        return codes.astype(np.uint8)

    @cached_property
    def estimated(self) -> np.ndarray:
        """The pixels whose values are kept, [rows, cols] bool: those of the mask and the unsure ones."""
        names = (["depth"] if self.has_depth else ["projector_u", "projector_v"]) if self.of_depth else ["normal"]
        told = [channel for name in names for channel in self._names.get(name, [])]
        return np.logical_or.reduce([self.mask, *(self._channels[channel] != 0 for channel in told)])

    @cached_property
    def on_object(self) -> np.ndarray:
        """The pixels that were to be solved, as far as the status tells, [rows, cols] bool."""
        return self.mask if self.status is None else self.mask | (self.status != Status.UNSOLVED)

    def names(self) -> list[str]:
        """Return the layers of the file in the order in which they are shown."""
        return [name for name in (DEPTH if self.of_depth else SURFACE) if name in self._names]

    def appearance(self, name: str) -> Appearance:
        """Return how a layer is shown."""
        shown = (DEPTH if self.of_depth else SURFACE)[name]
        return shown._replace(unit=PIXELS) if name == "height" and not self.camera.metric else shown

    def suffixes(self, name: str) -> list[str]:
        """Return the channels of a layer without its name, such as X, Y and Z."""
        return [channel.partition(".")[2] for channel in self._names[name]]

    def plane(self, name: str) -> np.ndarray:
        """Return the first channel of a layer, [rows, cols] in its stored type, which is kept."""
        return self._channels[self._names[name][0]]

    def take(self, name: str) -> np.ndarray:
        """Return a layer, [channels, rows, cols] in its stored type, and forget it."""
        _ = self.estimated, self.on_object  # which are made of layers that may be the next to be forgotten
        values = np.stack([self._channels.pop(channel) for channel in self._names[name]])
        if bad := int((~np.isfinite(values)).sum()):
            raise ResultError(f"{self.path}: layer {name} has {bad} values that are not finite")
        return values


def channels_of_layers(of_depth: bool) -> dict[str, list[str]]:
    """Return the channels of every layer that a depth.exr or a maps.exr may have."""
    if of_depth:
        return {name: [channel] for name, (channel, _) in depth_maps.LAYERS.items()}
    return {name: [f"{name}.{suffix}" for suffix in suffixes] for name, (suffixes, _) in maps.LAYERS.items()}
