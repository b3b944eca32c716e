"""Import of RTI `.lp` files: a count, then one line for each image with its name and the direction x y z of its light. Other tables of
lights with names of images under that ending are read as well (stage.importers.light_table).

The convention is that of RTIBuilder and its viewers: x right, y up, z towards the camera; the vector points to the light. The file
does not give the colour space: 8-bit images are taken as sRGB and others as scene-linear, and the manifest declares it. Nor does it mostly
give the strength of the lights, which are then declared equal, with an unknown common scale.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

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
    write_capture,
)
from stage.importers.light_table import LightTable, read_light_table

NO_UNIT = 2.0
"""Median length of the vectors of a file from which on they are no directions: those are one long, or a little off that by rounding."""


def import_folder(source: Path, destination: Path, *, view: View | None = None, color_space: ColorSpaceName | None = None,
                  white: float | None = None) -> Path:
    """Write a capture.json for an RTI capture.
    `source`: the .lp file, or a folder with exactly one .lp file. `color_space`: that of the images; None: by their depth. `white`:
    the reading of a white surface that faces a light; None: unknown."""
    path, folder, table, names = read_lights(source)
    if destination.resolve() in (path.parent.resolve(), path.parent.resolve().parent) and destination.resolve() != folder.resolve():
        raise ManifestError(f"{path}: its images lie in {folder}: import that folder, or give one for the capture")
    scale, irradiance = light_scale(white)
    strengths = irradiance * (np.ones((len(names), 3)) if table.strengths is None else table.strengths)
    first = folder / names[0]
    resolution = image_resolution(first)
    space = color_space or color_space_of(first)
    return write_capture({
        "name": path.stem,
        "color_space": space,
        "assumed": [*assumed_encoding(space, color_space), *_lengths(path, table.vectors),
                    *doubled_lights(names, table.vectors.tolist(), path)],
        "camera": (view or View()).entry(resolution),
        "mask": mask_beside(folder, names),
        "irradiance_scale": scale,
        "frames": [{"image": name, "light": {"type": "distant", "direction": direction, "irradiance": strength}}
                   for name, direction, strength in zip(names, table.vectors.tolist(), strengths.tolist(), strict=True)],
    }, path, destination, folder=folder)


class LightList(NamedTuple):
    """The lights of an .lp file and their images."""

    path: Path
    folder: Path
    """The folder of the images: that of the file, or the one that holds both, as RTIBuilder has assembly-files beside jpeg-exports."""
    table: LightTable
    images: list[str]
    """The image of each light, below the folder."""


def read_lights(source: Path) -> LightList:
    """Return the lights of an .lp file, or of the only one in a folder or in the folders in it, with their images."""
    path = _find(source)
    table = read_light_table(path, run="rows")
    if table.names is None:
        raise ManifestError(f"{path}: names no images: relit import olat takes lights in the order of the images")
    found: list[tuple[Path, list[str], list[str]]] = []
    for near in (path.parent, path.absolute().parent.parent):
        names = _images(near, table.names)
        found.append((near, names, [name for name in names if not inputs.is_file(near / name)]))
        if not found[-1][2]:
            break
    folder, names, lost = min(found, key=lambda one: len(one[2]))
    if lost:
        more = f", and {len(lost) - 1} more are not" if len(lost) > 1 else ""
        raise ManifestError(f"{path}: its image {lost[0]} is not in the folder{more}: find the images, or take their lines out")
    first: dict[str, str] = {}
    for given, name in zip(table.names, names, strict=True):
        if (before := first.setdefault(name, given)) != given:
            raise ManifestError(f"{path}: {before} and {given} are both {name}: each light has an image of its own")
    return LightList(path, folder, table, names)


def _lengths(path: Path, vectors: np.ndarray) -> list[str]:
    """Return the sentence for vectors that are as long as positions are."""
    lengths = np.linalg.norm(vectors, axis=1)
    if np.median(lengths) < NO_UNIT:
        return []
    return [f"frames[].light.direction: the vectors of {path.name} are {lengths.min():.3g} to {lengths.max():.3g} long, as positions are, "
            "and were taken as directions to far lights: if the lamps are near the object, relit import near-lights takes their positions"]


def _find(source: Path) -> Path:
    if source.is_file():
        return source
    with storage("read", source):
        found = [p for p in sorted(source.iterdir()) if p.suffix.lower() == ".lp"]
        found = found or [p for p in sorted(source.glob("*/*")) if p.suffix.lower() == ".lp"]
    if len(found) != 1:
        raise ManifestError(f"{source}: holds {len(found)} .lp files: name the one to import")
    return found[0]


def _images(folder: Path, given: Sequence[str]) -> list[str]:
    """Return the image below a folder that each name means, whether it is there or not."""
    beside = image_names(folder) if inputs.is_allowed(folder) else []
    return [_image(folder, beside, name) for name in given]


def _image(folder: Path, beside: list[str], given: str) -> str:
    """Return the image that a name means: they often hold folders of the machine that made the file, while the images lie beside the file,
    converted since, or in the last of these folders."""
    name = given.replace("\\", "/")
    near = "/".join(name.split("/")[-2:])
    with storage("read", folder / name):  # a name that is too long is an error of the file system
        for found in (name, near):
            if not found.startswith("/") and ":" not in found and inputs.is_file(folder / found):
                return found
    return image_named(name, beside) or name.rsplit("/", 1)[-1]
