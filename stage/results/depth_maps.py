"""The depth of one capture with what was measured beside it, or its decoded projector coordinates alone, and the file, depth.exr."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stage.capture.camera import Camera
from stage.errors import ResultError
from stage.formats import exr, exr_rows
from stage.results.result_metadata import camera_and_provenance, result_metadata

DEPTH_FILE = "depth.exr"
CALIBRATION_SIGMA = "relit:calibration_sigma_m"
"""The attribute with the standard deviation, in metres at the median depth, that the calibration leaves open of all depths together."""
LAYERS: dict[str, tuple[str, type[np.floating[Any]]]] = {
    "depth": ("depth.Z", np.float32),
    "range": ("range.Z", np.float32),
    "projector_u": ("projector.U", np.float32),
    "projector_v": ("projector.V", np.float32),
    "amplitude": ("amplitude.Y", np.float32),
    "sigma": ("sigma.Z", np.float32),
    "sigma_u": ("sigma.U", np.float32),
    "sigma_v": ("sigma.V", np.float32),
    "confidence": ("confidence.Y", np.float16),
    "status": ("status.Y", np.float16),
    "mask": ("mask.Y", np.float16),
}
"""The channel and the stored type of each layer."""
COORDINATES = ("projector_u", "projector_v", "sigma_u", "sigma_v")
"""Layers of projected patterns, which are kept where a pixel is decoded and has no depth."""


@dataclass(frozen=True, kw_only=True)
class DepthMaps:
    """The layers that were measured at each pixel. A layer that the method does not estimate is None."""

    camera: Camera
    mask: np.ndarray  # [rows, cols] bool, True where there is a depth
    depth: np.ndarray  # [rows, cols] float32 metres, positive in front of the camera (-z)
    range: np.ndarray | None = None  # [rows, cols] float32 metres along the ray
    projector_u: np.ndarray | None = None  # [rows, cols] float32 continuous projector column
    projector_v: np.ndarray | None = None  # [rows, cols] float32 continuous projector row
    amplitude: np.ndarray | None = None  # [rows, cols] float32 of the signal, in the unit of the images
    sigma: np.ndarray | None = None  # [rows, cols] float32 metres: standard deviation of the depth
    sigma_u: np.ndarray | None = None  # [rows, cols] float32 projector pixels: standard deviation of the decoded column
    sigma_v: np.ndarray | None = None  # [rows, cols] float32 projector pixels: standard deviation of the decoded row
    confidence: np.ndarray | None = None  # [rows, cols] 0…1
    status: np.ndarray | None = None  # [rows, cols] uint8, codes of the report
    estimated: np.ndarray | None = None  # [rows, cols] bool, where values are kept though they may not count as solved; None: the mask
    provenance: dict[str, str] = field(default_factory=dict)

    def layers(self) -> dict[str, np.ndarray]:
        """Return the layers that were estimated by their names, in the order of the file."""
        return {name: getattr(self, name) for name in LAYERS if getattr(self, name) is not None}

    def write(self, path: str | Path, progress: Callable[[int], None] = lambda rows: None) -> None:
        """Write depth.exr whole or not at all, with pixels that are not estimated 0 in every layer but `status` and COORDINATES.
        `progress`: told how many rows are written."""
        estimated = self.mask if self.estimated is None else self.mask | self.estimated
        channels = {}
        for name, values in self.layers().items():
            channel, dtype = LAYERS[name]
            kept = values if name in ("status", *COORDINATES) else np.where(estimated, values, 0)
            channels[channel] = kept.astype(dtype)
        exr_rows.write(path, channels, color_space=exr.DATA, metadata=result_metadata(self.camera, self.provenance), progress=progress)

    @classmethod
    def read(cls, path: str | Path, *, unsure: bool = False) -> "DepthMaps":
        """Read a depth.exr that Relit wrote.
        `unsure`: keep the values of pixels that are estimated and do not count as solved; else they are 0."""
        channels, metadata = exr.read(path)
        camera, provenance = camera_and_provenance(metadata, path, file_name=DEPTH_FILE)
        found = {name: channels[channel].astype(np.float32) for name, (channel, _) in LAYERS.items() if channel in channels}
        for name in ("mask", "depth"):
            if name not in found:
                alone = name == "depth" and any(layer in found for layer in COORDINATES)
                raise ResultError(f"{path}: has no layer {LAYERS[name][0]}" + (
                    ": it holds decoded projector coordinates alone, because the capture could not be triangulated" if alone else ""))
        status = found.pop("status", None)
        mask = found.pop("mask") > 0.5
        estimated = mask | (found["depth"] != 0) if unsure else None
        if not unsure:
            for values in found.values():
                values[~mask] = 0
        return cls(camera=camera, mask=mask, estimated=estimated, provenance=provenance,
                   status=None if status is None else status.astype(np.uint8), **found)


@dataclass(frozen=True, kw_only=True)
class CoordinateMaps:
    """Decoded projector coordinates without depth: the content of depth.exr where nothing could be triangulated."""

    camera: Camera
    mask: np.ndarray  # [rows, cols] bool, True where every coded axis is decoded
    projector_u: np.ndarray | None = None  # [rows, cols] float32 continuous projector column
    projector_v: np.ndarray | None = None  # [rows, cols] float32 continuous projector row
    sigma_u: np.ndarray | None = None  # [rows, cols] float32 projector pixels: standard deviation of the column
    sigma_v: np.ndarray | None = None  # [rows, cols] float32 projector pixels: standard deviation of the row
    amplitude: np.ndarray  # [rows, cols] float32 of the signal, in the unit of the images
    confidence: np.ndarray  # [rows, cols] 0…1
    status: np.ndarray  # [rows, cols] uint8, codes of the report
    provenance: dict[str, str] = field(default_factory=dict)

    def write(self, path: str | Path, progress: Callable[[int], None] = lambda rows: None) -> None:
        """Write depth.exr without layers of depth, whole or not at all; `progress`: told how many rows are written."""
        values = {name: getattr(self, name, None) for name in LAYERS}
        channels = {LAYERS[name][0]: layer.astype(LAYERS[name][1]) for name, layer in values.items() if layer is not None}
        exr_rows.write(path, channels, color_space=exr.DATA, metadata=result_metadata(self.camera, self.provenance), progress=progress)
