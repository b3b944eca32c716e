"""Solved depth of one capture, and its file: depth.exr."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from stage import exr
from stage.camera import Camera
from stage.errors import ResultError

DEPTH_FILE = "depth.exr"
LAYERS: dict[str, tuple[str, type[np.floating[Any]]]] = {
    "depth": ("depth.Z", np.float32),
    "range": ("range.Z", np.float32),
    "projector_u": ("projector.U", np.float32),
    "projector_v": ("projector.V", np.float32),
    "amplitude": ("amplitude.Y", np.float32),
    "sigma": ("sigma.Z", np.float32),
    "confidence": ("confidence.Y", np.float16),
    "status": ("status.Y", np.float16),
    "mask": ("mask.Y", np.float16),
}
"""Layer → its channel and the type that it is stored as."""


@dataclass(frozen=True, kw_only=True)
class DepthMaps:
    """What was measured at each pixel. A layer that the method does not estimate is None."""

    camera: Camera
    mask: np.ndarray  # [rows, cols] bool, True where there is a depth
    depth: np.ndarray  # [rows, cols] float32 metres, positive in front of the camera (-z)
    range: np.ndarray | None = None  # [rows, cols] float32 metres along the ray
    projector_u: np.ndarray | None = None  # [rows, cols] float32 continuous projector column
    projector_v: np.ndarray | None = None  # [rows, cols] float32 continuous projector row
    amplitude: np.ndarray | None = None  # [rows, cols] float32 of the signal, in the unit of the images
    sigma: np.ndarray | None = None  # [rows, cols] float32 metres: standard deviation of the depth
    confidence: np.ndarray | None = None  # [rows, cols] 0…1
    status: np.ndarray | None = None  # [rows, cols] uint8, codes of the report
    provenance: dict[str, str] = field(default_factory=dict)

    def layers(self) -> dict[str, np.ndarray]:
        """The layers that exist, by name, in file order."""
        return {name: getattr(self, name) for name in LAYERS if getattr(self, name) is not None}

    def write(self, path: str | Path) -> None:
        """Write depth.exr: temporary name, then rename; pixels outside the mask are 0 in every layer but status.

        Raises:
            StorageError: the file cannot be written.
        """
        channels = {}
        for name, values in self.layers().items():
            channel, dtype = LAYERS[name]
            kept = values if name == "status" else np.where(self.mask, values, 0)
            channels[channel] = kept.astype(dtype)
        metadata = {"relit:camera": self.camera.model_dump_json(), **self.provenance}
        exr.write(path, channels, color_space="lin_rec709_scene", metadata=metadata)

    @classmethod
    def read(cls, path: str | Path) -> "DepthMaps":
        """Read a depth.exr that Relit wrote.

        Raises:
            ResultError: a layer that there must be is not there, or the camera is not in the metadata.
            ImageError: not a readable EXR.
        """
        channels, metadata = exr.read(path)
        if "relit:camera" not in metadata:
            raise ResultError(f"{path}: carries no relit:camera attribute, so it is not a depth.exr of relit")
        found = {name: channels[channel].astype(np.float32) for name, (channel, _) in LAYERS.items() if channel in channels}
        for name in ("mask", "depth"):
            if name not in found:
                raise ResultError(f"{path}: has no layer {LAYERS[name][0]}")
        try:
            camera = Camera.model_validate_json(str(metadata["relit:camera"]))
        except ValidationError as error:
            raise ResultError(f"{path}: its relit:camera attribute is not a camera") from error
        provenance = {k: v for k, v in metadata.items() if k.startswith("relit:") and k != "relit:camera"}
        status = found.pop("status", None)
        return cls(camera=camera, mask=found.pop("mask") > 0.5, provenance=provenance,
                   status=None if status is None else status.astype(np.uint8), **found)
