"""Import of images under near point lights (LED rigs) with a file of their positions, as near_ps has it."""

from pathlib import Path
from typing import Any

import numpy as np

from stage.colour_spaces import ColorSpaceName
from stage.importers.layout import Imported, assumed_encoding, color_space_of, image_resolution, write_capture
from stage.importers.light_rig import LightRig, read_rig
from stage.importers.light_table import LightTable
from stage.importers.olat import find_table, match
from stage.importers.view import Axes, Selection, View, camera_from_table, describe, select, view_of_file
from stage.manifest import SCHEMA


def import_folder(source: Path, destination: Path, *, axes: Axes, unit_m: float, lights: Path | None = None, camera: Path | None = None,
                  selection: Selection | None = None, view: View | None = None, color_space: ColorSpaceName | None = None) -> Imported:
    """Write a capture.json for images under one near light each.

    Args:
        source: the folder of the images.
        destination: the folder of the capture; another folder than the source gets links to, or copies of, the images.
        axes: where x, y and z of the rig point, as seen by the camera, whose centre is their origin.
        unit_m: the metres in one unit of the positions.
        lights: the file of the rig; None: the only table in the folder.
        camera: a file with the matrix of the camera; None: as `view` says.
        selection: which images are frames; None: all but mask and ambient light.
        view: the camera; None: orthographic, of unknown scale.
        color_space: of the images; None: sRGB of 8-bit images, scene-linear of others.

    Raises:
        ManifestError: the rig or the camera cannot be read, images and lights do not fit, or a value is wrong; the message names the file.
        StorageError: a file cannot be read or written.
    """
    path = lights or find_table(source)
    rig = read_rig(path)
    chosen = select(source, selection or Selection())
    names, matched = match(path, LightTable(rig.names, rig.positions, rig.strengths, "rows", str(path)), chosen)
    resolution = image_resolution(source / names[0])
    view, camera_words = view_of_file(view or View(), camera, resolution)
    space = color_space or color_space_of(source / names[0])
    matrix = camera_from_table(axes)
    positions = unit_m * rig.positions @ matrix.T
    frames = [{"image": name, "light": entry} for name, entry in zip(names, _entries(rig, positions, matrix), strict=True)]
    frames += [{"image": chosen.ambient, "light": {"type": "off"}}] if chosen.ambient else []
    written = write_capture({
        "schema": SCHEMA, "name": source.resolve().name, "color_space": space, "camera": view.entry(resolution), "mask": chosen.mask,
        "irradiance_scale": "relative", "assumed": assumed_encoding(space, color_space), "frames": frames,
    }, path, destination, folder=source)
    far = np.linalg.norm(positions, axis=1)
    ahead = int((positions[:, 2] < 0).sum())
    return Imported(written, (
        ("lights", f"{len(names)} near lights from {path}, {matched}"),
        ("axes", f"{describe(axes)}, from the centre of the camera"),
        ("places", f"{far.min():.3g} to {far.max():.3g} m from the camera, {ahead} of them in front of it: if they should not be, --axes "
                   "or --unit-m is another"),
        ("lobes", "all directions alike" if rig.anisotropy is None or not rig.anisotropy.any() else
                  f"cos^mu about each light's direction, mu {rig.anisotropy.min():.3g} to {rig.anisotropy.max():.3g}"),
        ("strength", "equal: relit calibrate intensity measures it" if rig.strengths is None else
                     "as the file says, with an unknown factor"),
        ("colour", space + ("" if color_space else ", by the depth of the images: --color-space says another")),
        ("camera", camera_words), *chosen.facts()))


def _entries(rig: LightRig, positions: np.ndarray, matrix: np.ndarray) -> list[dict[str, Any]]:
    """Return the entries `light` of the manifest."""
    entries: list[dict[str, Any]] = []
    for index, position in enumerate(positions.tolist()):
        entry: dict[str, Any] = {"type": "point", "position_m": position,
                                 "intensity": [1.0, 1.0, 1.0] if rig.strengths is None else rig.strengths[index].tolist()}
        if rig.anisotropy is not None and rig.anisotropy[index] > 0 and rig.axes is not None:
            entry |= {"axis": (matrix @ rig.axes[index]).tolist(), "anisotropy": float(rig.anisotropy[index])}
        entries.append(entry)
    return entries
