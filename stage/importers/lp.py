"""Import of RTI `.lp` files: a count, then one line for each image with its name and the direction x y z of its light. Other tables of
lights with names of images under that ending are read as well (stage.importers.light_table).

The convention is that of RTIBuilder and its viewers: x right, y up, z towards the camera; the vector points to the light. The file
does not give the colour space: 8-bit images are taken as sRGB and others as scene-linear, and the manifest declares it. Nor does it mostly
give the strength of the lights, which are then declared equal, with an unknown common scale.
"""

from pathlib import Path

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
    path = _find(source)
    folder = path.parent
    scale, irradiance = light_scale(white)
    table, names = read_lights(path)
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
    }, path, destination)


def read_lights(path: Path) -> tuple[LightTable, list[str]]:
    """Return the lights of an .lp file, and the image of each in its folder."""
    table = read_light_table(path, run="rows")
    if table.names is None:
        raise ManifestError(f"{path}: names no images: relit import olat takes lights in the order of the images")
    beside = image_names(path.parent)
    names = [_image(path.parent, beside, name) for name in table.names]
    first: dict[str, str] = {}
    for given, name in zip(table.names, names, strict=True):
        if (before := first.setdefault(name, given)) != given:
            raise ManifestError(f"{path}: {before} and {given} are both {name}: each light has an image of its own")
    if missing := [name for name in names if not inputs.is_file(path.parent / name)]:
        more = f", and {len(missing) - 1} more are not" if len(missing) > 1 else ""
        raise ManifestError(f"{path}: its image {missing[0]} is not in the folder{more}: find the images, or take their lines out")
    return table, names


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
        found = sorted(p for p in source.iterdir() if p.suffix.lower() == ".lp")
    if len(found) != 1:
        raise ManifestError(f"{source}: holds {len(found)} .lp files: name the one to import")
    return found[0]


def _image(folder: Path, beside: list[str], given: str) -> str:
    """Return the image that a name means: they often hold folders of the machine that made the file, while the images lie beside the file,
    converted since."""
    name = given.replace("\\", "/")
    with storage("read", folder / name):  # a name that is too long is an error of the file system
        if not name.startswith("/") and ":" not in name and inputs.is_file(folder / name):
            return name
    return image_named(name, beside) or name.rsplit("/", 1)[-1]
