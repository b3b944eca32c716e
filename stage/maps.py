"""Solved maps of one capture, and their file: maps.exr."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from stage import exr
from stage.camera import Camera
from stage.errors import ResultError

MAPS_FILE = "maps.exr"
_RGB, _XYZ = ("R", "G", "B"), ("X", "Y", "Z")
LAYERS: dict[str, tuple[tuple[str, ...], type[np.floating[Any]]]] = {
    "normal": (_XYZ, np.float32),
    "diffuse_albedo": (_RGB, np.float16),
    "specular": (_RGB, np.float16),
    "roughness": (("Y",), np.float16),
    "regime": (("Y",), np.float16),
    "specular_normal": (_XYZ, np.float32),
    "height": (("Z",), np.float32),
    "confidence": (("Y",), np.float16),
    "mask": (("Y",), np.float16),
}
"""Layer name → its channels and the type it is stored as: geometry in float, the rest in half."""


@dataclass(frozen=True, kw_only=True)
class SurfaceMaps:
    """What a solver found at each pixel. A layer that the method does not estimate is None."""

    camera: Camera
    mask: np.ndarray  # [rows, cols] bool, True where the solver has a result
    normal: np.ndarray | None = None  # [rows, cols, 3] float32, unit, camera frame
    diffuse_albedo: np.ndarray | None = None  # [rows, cols, 3] scene-linear, 0…1
    specular: np.ndarray | None = None  # [rows, cols, 3] F0, scene-linear, 0…1
    roughness: np.ndarray | None = None  # [rows, cols] 0…1, alpha = roughness²
    regime: np.ndarray | None = None  # [rows, cols] 1 Lambertian, 2 glossy, 3 mirror, 4 mixture of diffuse and specular
    specular_normal: np.ndarray | None = None  # [rows, cols, 3] float32, unit, of the highlight; 0 where none was found
    height: np.ndarray | None = None  # [rows, cols] float32, camera-frame z; metres, or pixels without a scale
    confidence: np.ndarray | None = None  # [rows, cols] 0…1
    color_space: str = "lin_rec709_scene"
    provenance: dict[str, str] = field(default_factory=dict)

    def layers(self) -> dict[str, np.ndarray]:
        """The layers that exist, by name, in file order."""
        return {name: getattr(self, name) for name in LAYERS if getattr(self, name) is not None}

    def write(self, path: str | Path) -> None:
        """Write maps.exr: temporary name, then rename; pixels outside the mask are 0 in every layer.

        Raises:
            StorageError: the file cannot be written.
        """
        channels: dict[str, np.ndarray] = {}
        for name, values in self.layers().items():
            suffixes, dtype = LAYERS[name]
            masked = np.where(self.mask if values.ndim == 2 else self.mask[..., None], values, 0).astype(dtype)
            for c, suffix in enumerate(suffixes):
                channels[f"{name}.{suffix}"] = masked if masked.ndim == 2 else masked[..., c]
        metadata = {"relit:camera": self.camera.model_dump_json(), **self.provenance}
        exr.write(path, channels, color_space=self.color_space, metadata=metadata)

    @classmethod
    def read(cls, path: str | Path) -> "SurfaceMaps":
        """Read a maps.exr that Relit wrote.

        Raises:
            ResultError: a layer is incomplete or not finite, or the camera is not in the metadata.
            ImageError: not a readable EXR.
        """
        channels, metadata = exr.read(path)
        if "relit:camera" not in metadata:
            raise ResultError(f"{path}: carries no relit:camera attribute, so it is not a maps.exr of relit")
        found: dict[str, np.ndarray] = {}
        for name, (suffixes, _) in LAYERS.items():
            names = [f"{name}.{s}" for s in suffixes]
            present = [n for n in names if n in channels]
            if not present:
                continue
            if len(present) < len(names):
                raise ResultError(f"{path}: layer {name} lacks channel {next(n for n in names if n not in channels)}")
            planes = [channels[n].astype(np.float32) for n in names]
            if bad := sum(int((~np.isfinite(plane)).sum()) for plane in planes):
                raise ResultError(f"{path}: layer {name} has {bad} values that are not finite")
            found[name] = planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
        if "mask" not in found:
            raise ResultError(f"{path}: has no layer mask.Y")
        mask = found.pop("mask") > 0.5
        provenance = {k: v for k, v in metadata.items() if k.startswith("relit:") and k != "relit:camera"}
        try:
            camera = Camera.model_validate_json(str(metadata["relit:camera"]))
        except ValidationError as error:
            raise ResultError(f"{path}: its relit:camera attribute is not a camera") from error
        if mask.shape != (camera.height, camera.width):
            raise ResultError(f"{path}: is {mask.shape[1]}x{mask.shape[0]}, its camera {camera.width}x{camera.height}")
        return cls(camera=camera, mask=mask, color_space=exr.color_space_of(metadata), provenance=provenance, **found)


