"""The coefficient images of a capture in one EXR, and the matrices that turn light weights into their coefficients in JSON beside it.

    frame[c] = Σₖ (Σₗ matrix[c][k][l] · weight[c][l]) · basis.k[c],     frame = Σₗ weight[l] · (captured image l)

so that a browser relights with K images where the capture has L. Under an environment, weight = (∫ of its radiance over the light's
part of the sphere) / irradiance of the light.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stage import exr
from stage.files import write_text

SCHEMA = "relit.basis/1"
HALF_MAX = 65504.0
HALF_RMS_MIN = 2.0**-11
"""Least root mean square of a layer in half: an eighth of it still has all bits of a half value."""
DIGITS = 9
"""Of the numbers in JSON: a float32 comes back as it was."""


def layer_name(index: int) -> str:
    """`basis.000`, …"""
    return f"basis.{index:03d}"


def layer_types(rms: np.ndarray, largest: float) -> list[type[np.floating[Any]]]:
    """What each layer is stored as: half, or float where half would overflow or lose bits.

    Args:
        rms: [K, 3] root mean square of each coefficient image.
        largest: no value of any layer is beyond.
    """
    return [np.float16 if largest <= HALF_MAX and row.max() >= HALF_RMS_MIN else np.float32 for row in rms]


def write_layers(path: str | Path, layers: Sequence[np.ndarray], mask: np.ndarray, *, color_space: str,
                 metadata: Mapping[str, str]) -> None:
    """Write the coefficient images as layers `basis.NNN.{R,G,B}`, and `mask.Y`; outside the mask they are 0.

    Args:
        layers: of each index [3, rows, cols] float16 or float32.
        mask: [rows, cols] bool.

    Raises:
        StorageError: the file cannot be written; nothing is left behind.
    """
    channels = {f"{layer_name(k)}.{name}": np.where(mask, plane, 0).astype(plane.dtype)
                for k, layer in enumerate(layers) for name, plane in zip("RGB", layer, strict=True)}
    exr.write(path, {**channels, "mask.Y": mask.astype(np.float16)}, color_space=color_space, metadata=metadata)


def facts_path(path: str | Path) -> Path:
    """The JSON beside a basis: its name and `.json`, so that files of several kinds can share a folder and a stem."""
    return Path(path).with_name(f"{Path(path).name}.json")


def write_facts(path: str | Path, facts: Mapping[str, Any]) -> Path:
    """Write the JSON beside a basis.

    Returns:
        Where it is.

    Raises:
        StorageError: the file cannot be written; nothing is left behind.
    """
    target = facts_path(path)
    write_text(target, json.dumps({"schema": SCHEMA, **facts}) + "\n")
    return target


def numbers(value: Any) -> Any:
    """A number, or an array as nested lists, shortened to what a float32 holds."""
    if np.ndim(value) == 0:
        return float(f"{float(value):.{DIGITS}g}")
    return [numbers(row) for row in value]
