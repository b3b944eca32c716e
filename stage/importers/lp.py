"""Import of RTI `.lp` files: a count, then one line for each image with its name and the direction x y z of its light.

The convention is that of RTIBuilder and its viewers: x right, y up, z towards the camera; the vector points to the light. The file
does not give the colour space: 8-bit images are taken as sRGB and others as scene-linear, and the manifest declares it. Nor does it give
the strength of the lights, which are declared equal, with an unknown common scale.
"""

from pathlib import Path
from typing import Any

import numpy as np

from stage import inputs
from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import ManifestError, storage
from stage.importers.camera_options import View, mask_beside
from stage.importers.layout import (
    assumed_encoding,
    color_space_of,
    doubled_lights,
    image_named,
    image_names,
    image_resolution,
    light_scale,
    read_lines,
    write_capture,
)
from stage.importers.light_table import check_angles
from stage.model import name_fault

NO_UNIT = 2.0
"""Median length of the vectors of a file from which on they are no directions: those are one long, or a little off that by rounding."""


def import_folder(source: Path, destination: Path, *, view: View | None = None, color_space: ColorSpaceName | None = None,
                  white: float | None = None) -> Path:
    """Write a capture.json for an RTI capture.
    `source`: the .lp file, or a folder with exactly one .lp file. `color_space`: that of the images; None: by their depth. `white`:
    the reading of a white surface that faces a light; None: unknown."""
    path = _find(source)
    folder = path.parent
    lines = read_lines(path)
    if not lines or not lines[0][1].isdecimal():
        raise ManifestError(f"{path}: line {lines[0][0] if lines else 1}: must be the count of images")
    count, rows = int(lines[0][1]), lines[1:]
    if count != len(rows):
        raise ManifestError(f"{path}: says {count} images, holds {len(rows)}")
    scale, irradiance = light_scale(white)
    beside = image_names(folder)
    frames = [_frame(path, folder, beside, number, row, irradiance) for number, row in rows]
    if not frames:
        raise ManifestError(f"{path}: names no image")
    named: dict[str, int] = {}
    for (number, _), frame in zip(rows, frames, strict=True):
        before = named.setdefault(frame["image"], number)
        if before != number:
            raise ManifestError(f"{path}: line {number}: names {frame['image']}, which line {before} names already: each light has an "
                                "image of its own")
    first = folder / frames[0]["image"]
    resolution = image_resolution(first)
    check_angles(np.array([frame["light"]["direction"] for frame in frames]), str(path))
    space = color_space or color_space_of(first)
    return write_capture({
        "name": path.stem,
        "color_space": space,
        "assumed": [*assumed_encoding(space, color_space), *_lengths(path, frames), *doubled_lights(
            [f"line {number} ({frame['image']})" for (number, _), frame in zip(rows, frames, strict=True)],
            [frame["light"]["direction"] for frame in frames], path)],
        "camera": (view or View()).entry(resolution),
        "mask": mask_beside(folder, list(named)),
        "irradiance_scale": scale,
        "frames": frames,
    }, path, destination)


def _lengths(path: Path, frames: list[dict[str, Any]]) -> list[str]:
    """Return the sentence for vectors that are as long as positions are."""
    lengths = np.linalg.norm([frame["light"]["direction"] for frame in frames], axis=1)
    if np.median(lengths) < NO_UNIT:
        return []
    return [f"frames[].light.direction: the vectors of {path.name} are {lengths.min():.3g} to {lengths.max():.3g} long, as positions are, "
            "and were taken as directions to far lights: if the lamps are near the object, relit import near-lights takes their positions"]


def _find(source: Path) -> Path:
    if source.is_file():
        return source
    with storage("read", source):
        found = sorted(p for p in source.iterdir() if p.suffix.lower() == ".lp")
    if len(found) != 1:
        raise ManifestError(f"{source}: holds {len(found)} .lp files: name the one to import")
    return found[0]


def _frame(path: Path, folder: Path, beside: list[str], number: int, row: str, irradiance: float) -> dict[str, Any]:
    parts = row.rsplit(maxsplit=3)  # a name may hold spaces
    try:
        direction = [float(part) for part in parts[1:]]
    except ValueError:
        direction = []
    if len(direction) != 3 or not np.isfinite(direction).all():
        raise ManifestError(f"{path}: line {number}: {row[:60]!r} is not an image name and three numbers")
    if not any(direction):
        raise ManifestError(f"{path}: line {number}: the light direction has zero length")
    if (fault := name_fault(parts[0])) is not None:
        raise ManifestError(f"{path}: line {number}: the image name {fault}")
    # names often hold folders of the machine that made the file, while the images lie beside the file, converted since
    name = parts[0].strip('"').replace("\\", "/")
    with storage("read", folder / name):  # a name that is too long is an error of the file system
        relative = name if not name.startswith("/") and ":" not in name and inputs.is_file(folder / name) else (
            image_named(name, beside) or name.rsplit("/", 1)[-1])
    return {"image": relative, "light": {"type": "distant", "direction": direction, "irradiance": [irradiance] * 3}}
