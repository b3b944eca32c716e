"""Import of images under one far light each where nothing says where the lights were: all get the placeholder of calibration."""

from pathlib import Path
from typing import Any

from stage.colour_spaces import ColorSpaceName
from stage.errors import ManifestError
from stage.importers.layout import Imported, assumed_encoding, color_space_of, image_resolution, write_capture
from stage.importers.view import Selection, View, select
from stage.light import PLACEHOLDER
from stage.lighting import MEASURED_BY
from stage.manifest import SCHEMA

LEAST = 3
"""The fewest images from which a normal can be solved, whoever measures the lights."""


def import_folder(source: Path, destination: Path, *, selection: Selection | None = None, view: View | None = None,
                  color_space: ColorSpaceName | None = None) -> Imported:
    """Write a capture.json for images whose lights are yet to be measured.

    Args:
        source: the folder of the images.
        destination: the folder of the capture; another folder than the source gets links to, or copies of, the images.
        selection: which images are frames; None: all but mask and ambient light.
        view: the camera; None: orthographic, of unknown scale.
        color_space: of the images; None: sRGB of 8-bit images, scene-linear of others.

    Raises:
        ManifestError: there are fewer than three images; the message names the folder.
        StorageError: a file cannot be read or written.
    """
    chosen = select(source, selection or Selection())
    names = chosen.frames
    if len(names) < LEAST:
        raise ManifestError(f"{source}: has {len(names)} images: normals need {LEAST} or more")
    space, view = color_space or color_space_of(source / names[0]), view or View()
    light = PLACEHOLDER.model_dump(mode="json")
    frames: list[dict[str, Any]] = [{"image": name, "light": light} for name in names]
    frames += [{"image": chosen.ambient, "light": {"type": "off"}}] if chosen.ambient else []
    written = write_capture({
        "schema": SCHEMA, "name": source.resolve().name, "color_space": space, "camera": view.entry(image_resolution(source / names[0])),
        "mask": chosen.mask, "irradiance_scale": "relative", "assumed": assumed_encoding(space, color_space), "frames": frames,
    }, source, destination, folder=source)
    return Imported(written, (
        ("lights", f"{len(names)} placeholders, {names[0]} to {names[-1]}: relit solve --lights unknown finds them from the images; "
                   f"{MEASURED_BY}"),
        ("colour", space + ("" if color_space else ", by the depth of the images: --color-space says another")),
        ("camera", view.describe()), *chosen.facts()))
