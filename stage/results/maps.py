"""The solved surface maps of one capture, and their file, maps.exr."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.point_lights import distance_is_missing
from stage.errors import ResultError
from stage.formats import exr, exr_rows
from stage.results.normal_axes import normal_fault
from stage.results.result_metadata import camera_and_provenance, result_metadata

MAPS_FILE = "maps.exr"
ALBEDO_SCALE = "relit:albedo_scale"
"""The attribute with the factor between the albedo of the maps and that under the lights of the capture, where it is not 1."""
JOINED = "relit:joined"
"""The attribute of maps whose height a depth has placed, with the content hashes of both: surface_z_m of their camera is its mean."""
_RGB, _XYZ = ("R", "G", "B"), ("X", "Y", "Z")
LAYERS: dict[str, tuple[tuple[str, ...], type[np.floating[Any]]]] = {
    "normal": (_XYZ, np.float32),
    "diffuse_albedo": (_RGB, np.float16),
    "diffuse_albedo_sigma": (_RGB, np.float16),
    "specular": (_RGB, np.float16),
    "roughness": (("Y",), np.float16),
    "abundance": (("Y",), np.float16),
    "first_specular": (_RGB, np.float16),
    "first_roughness": (("Y",), np.float16),
    "second_specular": (_RGB, np.float16),
    "second_roughness": (("Y",), np.float16),
    "regime": (("Y",), np.float16),
    "specular_normal": (_XYZ, np.float32),
    "height": (("Z",), np.float32),
    "height_sigma": (("Z",), np.float32),
    "part": (("Y",), np.float16),
    "sigma": (("Y",), np.float16),
    "confidence": (("Y",), np.float16),
    "status": (("Y",), np.float16),
    "mask": (("Y",), np.float16),
}
"""The channels and the stored type of each layer: geometry is stored as float, the rest as half."""
LOBES = (("specular", "roughness"), ("first_specular", "first_roughness"), ("second_specular", "second_roughness"))
"""The layers of each specular lobe: that of the whole pixel, and those of the two materials of a pixel that mixes them."""


@dataclass(frozen=True, kw_only=True)
class SurfaceMaps:
    """The layers that a solver estimated at each pixel. A layer that the method does not estimate is None."""

    camera: Camera
    mask: np.ndarray  # [rows, cols] bool, True where the solver has a result
    normal: np.ndarray | None = None  # [rows, cols, 3] float32, unit, camera frame
    diffuse_albedo: np.ndarray | None = None  # [rows, cols, 3] scene-linear, 0…1
    diffuse_albedo_sigma: np.ndarray | None = None  # [rows, cols, 3] its standard deviation, without that of the scale of all albedo
    specular: np.ndarray | None = None  # [rows, cols, 3] F0, scene-linear, 0…1
    roughness: np.ndarray | None = None  # [rows, cols] 0…1, alpha = roughness²
    abundance: np.ndarray | None = None  # [rows, cols] share of the first of two materials; 0 where the pixel has one
    first_specular: np.ndarray | None = None  # [rows, cols, 3] F0 of the first material; 0 where the pixel has one
    first_roughness: np.ndarray | None = None  # [rows, cols]
    second_specular: np.ndarray | None = None  # [rows, cols, 3] F0 of the second
    second_roughness: np.ndarray | None = None  # [rows, cols]
    regime: np.ndarray | None = None  # [rows, cols] 1 Lambertian, 2 glossy, 3 mirror, 4 mixture of diffuse and specular
    specular_normal: np.ndarray | None = None  # [rows, cols, 3] float32, unit, of the highlight; 0 where none was found
    height: np.ndarray | None = None  # [rows, cols] float32, camera-frame z; metres, or pixels without a scale
    height_sigma: np.ndarray | None = None  # [rows, cols] float32 standard error of the height, in its unit; where depth has placed it
    part: np.ndarray | None = None  # [rows, cols] uint8, parts with a break of the height between them, 1 the largest; None: there is one
    sigma: np.ndarray | None = None  # [rows, cols] standard error of the normal, degrees
    confidence: np.ndarray | None = None  # [rows, cols] 0…1
    status: np.ndarray | None = None  # [rows, cols] uint8, codes of the report
    estimated: np.ndarray | None = None  # [rows, cols] bool, where values are kept though they may not count as solved; None: the mask
    color_space: str = "lin_rec709_scene"
    provenance: dict[str, str] = field(default_factory=dict)

    def layers(self) -> dict[str, np.ndarray]:
        """Return the layers that were estimated by their names, in the order of the file."""
        return {name: getattr(self, name) for name in LAYERS if getattr(self, name) is not None}

    def with_lobes(self, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> "SurfaceMaps":
        """Return maps in which `change` replaced F0 [rows, cols, 3] and roughness [rows, cols] of every specular lobe."""
        changed: dict[str, Any] = {}
        for specular, roughness in LOBES:
            lobe = getattr(self, specular), getattr(self, roughness)
            if all(values is not None for values in lobe):
                changed[specular], changed[roughness] = change(*lobe)
        return replace(self, **changed)

    def write(self, path: str | Path, progress: Callable[[int], None] = lambda rows: None) -> None:
        """Write maps.exr whole or not at all, with pixels that are not estimated 0 in every layer but `status`; `progress`: told how many
        rows are written."""
        kept = self.mask if self.estimated is None else self.mask | self.estimated
        channels: dict[str, np.ndarray] = {}
        for name, values in self.layers().items():
            suffixes, dtype = LAYERS[name]
            for plane, suffix in zip([values] if values.ndim == 2 else np.moveaxis(values, -1, 0), suffixes, strict=True):
                stored = channels[f"{name}.{suffix}"] = np.zeros(plane.shape, dtype)
                np.copyto(stored, plane, where=True if name == "status" else kept, casting="same_kind")
        metadata = result_metadata(self.camera, self.provenance)
        exr_rows.write(path, channels, color_space=self.color_space, metadata=metadata, progress=progress)

    @classmethod
    def read(cls, path: str | Path, *, unsure: bool = False, layers: Collection[str] = tuple(LAYERS)) -> "SurfaceMaps":
        """Read a maps.exr that Relit wrote.
        `unsure`: keep the values of pixels that are estimated and do not count as solved; else they are 0. `layers`: the layers to read
        beside `mask`; the others are None."""
        channels, metadata = exr.read(path)
        camera, provenance = camera_and_provenance(metadata, path, file_name=MAPS_FILE)
        found: dict[str, np.ndarray] = {}
        for name, (suffixes, _) in LAYERS.items():
            names = [f"{name}.{s}" for s in suffixes]
            if name not in layers and name != "mask":
                for unused in names:
                    channels.pop(unused, None)
                continue
            present = [n for n in names if n in channels]
            if not present:
                continue
            if len(present) < len(names):
                raise ResultError(f"{path}: layer {name} lacks channel {next(n for n in names if n not in channels)}")
            planes = [channels.pop(n).astype(np.float32) for n in names]
            if bad := sum(int((~np.isfinite(plane)).sum()) for plane in planes):
                raise ResultError(f"{path}: layer {name} has {bad} values that are not finite")
            found[name] = planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
        if "mask" not in found:
            raise ResultError(f"{path}: has no layer mask.Y")
        mask = found.pop("mask") > 0.5
        if mask.shape != (camera.height, camera.width):
            raise ResultError(f"{path}: is {mask.shape[1]}x{mask.shape[0]}, its camera {camera.width}x{camera.height}")
        if "normal" in found and (fault := normal_fault(camera, mask, found["normal"], found.get("height"), found.get("part"))) is not None:
            raise ResultError(f"{path}: {fault}")
        estimated = None
        if unsure:
            estimated = mask | (found["normal"].any(axis=-1) if "normal" in found else False)
        else:
            for name, values in found.items():
                if name != "status":
                    values[~mask] = 0
        for name in ("status", "part"):
            if name in found:
                found[name] = found[name].astype(np.uint8)
        return cls(camera=camera, mask=mask, estimated=estimated, color_space=exr.color_space_of(metadata), provenance=provenance, **found)


def capture_as_solved(capture: Capture, path: Path) -> Capture:
    """Return a capture with what its solve has added: the distance of the surface, where the manifest lacks it and its near lights need it,
    or where a depth was joined with the maps, and lights under which the albedo of the maps in this file looks as the images do."""
    metadata = exr.read_header(path).metadata
    found = camera_and_provenance(metadata, path, file_name=MAPS_FILE)[0].surface_z_m
    if found is not None and (JOINED in metadata or distance_is_missing(capture)):
        capture = capture.at_distance(found)
    told = str(metadata.get(ALBEDO_SCALE, 1))
    try:
        scale = float(told)
    except ValueError:
        scale = 0.0
    if not 0 < scale < np.inf:
        raise ResultError(f"{path}: its attribute {ALBEDO_SCALE} is {told}: it must be a number above 0")
    return capture.with_brighter_lights(1 / scale)
