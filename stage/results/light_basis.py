"""The file of a light basis: its images in one EXR, and beside it, in JSON, the matrices from light weights to coefficients.

    frame[c] = Σₖ (Σₗ matrix[c][k][l] · weight[c][l]) · basis.k[c],     frame = Σₗ weight[l] · (captured image l)

With it a browser relights from K images instead of the L images of the capture. Under an environment the weight of a light is the
integral of the radiance over its part of the sphere, divided by its irradiance.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stage.files import write_text
from stage.formats import exr, exr_rows

SCHEMA = "relit.basis/1"
HALF_RMS_MIN = 2.0**-11
"""The least root mean square of a layer that is stored as half: an eighth of it still has all bits of a half value."""
DIGITS = 9
"""The significant digits of a number in JSON, which restore every float32 exactly."""


def layer_name(index: int) -> str:
    """Return the name of a layer: `basis.000`, `basis.001` and so on."""
    return f"basis.{index:03d}"


def layer_types(rms: np.ndarray, largest: float) -> list[type[np.floating[Any]]]:
    """Return the stored type of each layer: half, or float when half would overflow or lose bits.
    `rms`: [K, 3] the root mean square of each basis image. `largest`: an upper bound of the absolute values of all layers."""
    return [np.float16 if largest <= exr.HALF_MAX and row.max() >= HALF_RMS_MIN else np.float32 for row in rms]


def write_layers(path: str | Path, layers: Sequence[np.ndarray], mask: np.ndarray, *, color_space: str,
                 metadata: Mapping[str, str], progress: Callable[[int], None]) -> None:
    """Write the basis images as layers `basis.NNN.{R,G,B}`, which are 0 outside the mask, and the mask as `mask.Y`.
    `layers`: K images, each [3, rows, cols] float16 or float32. `mask`: [rows, cols] bool. `progress`: told how many rows are written."""
    channels = {f"{layer_name(k)}.{name}": np.where(mask, plane, 0).astype(plane.dtype)
                for k, layer in enumerate(layers) for name, plane in zip("RGB", layer, strict=True)}
    exr_rows.write(path, {**channels, "mask.Y": mask.astype(np.float16)}, color_space=color_space, metadata=metadata, progress=progress)


def facts_path(path: str | Path) -> Path:
    """Return the path of the JSON file beside a basis: the whole file name of the basis and `.json`."""
    return Path(path).with_name(f"{Path(path).name}.json")


def write_facts(path: str | Path, facts: Mapping[str, Any]) -> Path:
    """Write the JSON file beside a basis."""
    target = facts_path(path)
    write_text(target, json.dumps({"schema": SCHEMA, **facts}) + "\n")
    return target


def numbers(value: Any) -> Any:
    """Return a number, or an array as nested lists, rounded to the digits of a float32."""
    if np.ndim(value) == 0:
        return float(f"{float(value):.{DIGITS}g}")
    return [numbers(row) for row in value]
