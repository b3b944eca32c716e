"""Import of images under one light each (OLAT): far lights in a table, near lights (LED rigs) in a file, or lights that nobody knows yet.

The axes of a table, and whether its vectors point to the light, are told and never guessed. Files of near lights are those of near_ps.
Lights that nothing tells get the placeholder of calibration.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stage.capture.light import PLACEHOLDER
from stage.capture.lighting import MEASURED_BY
from stage.capture.manifest import FILE_NAME
from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import ManifestError, storage
from stage.folders import natural_order
from stage.importers.camera_options import Axes, Selected, Selection, View, camera_from_table, describe, select, view_of_file
from stage.importers.layout import (
    Imported,
    assumed_encoding,
    color_space_of,
    doubled_lights,
    image_named,
    image_resolution,
    light_scale,
    write_capture,
)
from stage.importers.light_rig import LightRig, read_rig
from stage.importers.light_table import SUFFIXES, LightTable, Run, read_light_table, read_strengths

LEAST = 3
"""The fewest images from which a normal can be solved, whoever measures the lights."""


def import_folder(source: Path, destination: Path, *, axes: Axes, to_light: bool, lights: Path | None = None, variable: str | None = None,
                  run: Run | None = None, strengths: Path | None = None, selection: Selection | None = None, view: View | None = None,
                  color_space: ColorSpaceName | None = None, white: float | None = None) -> Imported:
    """Write a capture.json for images under one far light each.

    Args:
        axes: where x, y and z of the table point, as seen by the camera.
        to_light: whether the vectors point to the light, as directions and positions seen from the object do; False: along its rays.
        variable, run: as `read_light_table` takes them.
        strengths: a file with the strength of each light; None: that in the table, else equal.
        white: the reading of a white surface that faces a light of strength 1; None: unknown.
    """
    path = lights or find_table(source)
    table = read_light_table(path, variable=variable, run=run)
    chosen = select(source, selection or Selection())
    names, matched = match(path, table, chosen)
    strength = table.strengths if strengths is None else read_strengths(strengths)
    if strength is not None and len(strength) != len(names):
        raise ManifestError(f"{strengths or path}: has {len(strength)} strengths, the table {len(names)} lights")
    directions = table.vectors @ camera_from_table(axes).T * (1 if to_light else -1)
    scale, unit = light_scale(white)
    irradiance = unit * (np.ones((len(names), 3)) if strength is None else strength)
    behind = int((directions[:, 2] < 0).sum())
    lit = [{"type": "distant", "direction": list(direction), "irradiance": list(power)}
           for direction, power in zip(directions.tolist(), irradiance.tolist(), strict=True)]
    return _written(source, destination, path, names, lit, chosen, view, None, color_space, scale=scale, facts=(
        ("lights", f"{len(names)} from {table.what}, {matched}"),
        ("axes", f"{describe(axes)}; vectors {'point to the light' if to_light else 'point along the rays, from the light'}"),
        ("side", f"{len(names) - behind} lights stand on the camera's side of the object, {behind} behind it"
                 + (": if they should not, --axes or --vectors is another" if behind else "")),
        ("strength", "equal: relit calibrate intensity measures it" if strength is None else "as the table says, with an unknown factor")))


def import_near_lights(source: Path, destination: Path, *, axes: Axes, unit_m: float, lights: Path | None = None,
                       camera: Path | None = None, selection: Selection | None = None, view: View | None = None,
                       color_space: ColorSpaceName | None = None) -> Imported:
    """Write a capture.json for images under one near light each.
    `axes`: where x, y and z of the rig point, as seen by the camera, whose centre is their origin. `unit_m`: the metres in one unit of the
    positions."""
    path = lights or find_table(source)
    rig = read_rig(path)
    chosen = select(source, selection or Selection())
    names, matched = match(path, LightTable(rig.names, rig.positions, rig.strengths, "rows", str(path)), chosen)
    matrix = camera_from_table(axes)
    positions = unit_m * rig.positions @ matrix.T
    far = np.linalg.norm(positions, axis=1)
    ahead = int((positions[:, 2] < 0).sum())
    return _written(source, destination, path, names, _entries(rig, positions, matrix), chosen, view, camera, color_space, facts=(
        ("lights", f"{len(names)} near lights from {path}, {matched}"),
        ("axes", f"{describe(axes)}, from the centre of the camera"),
        ("places", f"{far.min():.3g} to {far.max():.3g} m from the camera, {ahead} of them in front of it: if they should not be, --axes "
                   "or --unit-m is another"),
        ("lobes", "all directions alike" if rig.anisotropy is None or not rig.anisotropy.any() else
                  f"cos^mu about each light's direction, mu {rig.anisotropy.min():.3g} to {rig.anisotropy.max():.3g}"),
        ("strength", "equal: relit calibrate intensity measures it" if rig.strengths is None else
                     "as the file says, with an unknown factor")))


def _entries(rig: LightRig, positions: np.ndarray, matrix: np.ndarray) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = []
    for index, position in enumerate(positions.tolist()):
        entry: dict[str, Any] = {"type": "point", "position_m": position,
                                 "intensity": [1.0, 1.0, 1.0] if rig.strengths is None else rig.strengths[index].tolist()}
        if rig.anisotropy is not None and rig.anisotropy[index] > 0 and rig.axes is not None:
            entry |= {"axis": (matrix @ rig.axes[index]).tolist(), "anisotropy": float(rig.anisotropy[index])}
        entries.append(entry)
    return entries


def import_photos(source: Path, destination: Path, *, selection: Selection | None = None, view: View | None = None,
                  color_space: ColorSpaceName | None = None) -> Imported:
    """Write a capture.json for images whose lights are yet to be measured."""
    chosen = select(source, selection or Selection())
    names = chosen.frames
    if len(names) < LEAST:
        raise ManifestError(f"{source}: has {len(names)} images: normals need {LEAST} or more")
    lights = [PLACEHOLDER.model_dump(mode="json")] * len(names)
    return _written(source, destination, source, names, lights, chosen, view, None, color_space, facts=(
        ("lights", f"{len(names)} placeholders, {names[0]} to {names[-1]}: relit solve --lights unknown finds them from the images; "
                   f"{MEASURED_BY}"),))


def _written(source: Path, destination: Path, table: Path, names: Sequence[str], lights: list[dict[str, Any]], chosen: Selected,
             view: View | None, camera: Path | None, color_space: ColorSpaceName | None, *, facts: tuple[tuple[str, str], ...],
             scale: str = "relative") -> Imported:
    """Write the capture of images under one light each, with the image of ambient light, and add what was understood of the images."""
    space = color_space or color_space_of(source / names[0])
    resolution = image_resolution(source / names[0])
    view, camera_words = view_of_file(view or View(), camera, resolution)
    frames: list[dict[str, Any]] = [{"image": name, "light": light} for name, light in zip(names, lights, strict=True)]
    frames += [{"image": chosen.ambient, "light": {"type": "off"}}] if chosen.ambient else []
    written = write_capture({
        "name": source.resolve().name, "color_space": space, "camera": view.entry(resolution), "mask": chosen.mask,
        "irradiance_scale": scale,
        "assumed": [*assumed_encoding(space, color_space),
                    *doubled_lights(names, [light.get("direction", light.get("position_m", [])) for light in lights], table)],
        "frames": frames,
    }, table, destination, folder=source)
    return Imported(written, (
        *facts, ("colour", space + ("" if color_space else ", by the depth of the images: --color-space says another")),
        ("camera", camera_words), *chosen.facts()))


def find_table(source: Path) -> Path:
    """Return the only table of lights in a folder."""
    with storage("read", source):
        found = natural_order(path.name for path in source.iterdir() if path.suffix.lower() in SUFFIXES and path.name != FILE_NAME
                              and not path.name.startswith("."))
    if len(found) != 1:
        raise ManifestError(f"{source}: holds {', '.join(found) or 'no table of lights'}: name that of the lights with --lights")
    return source / found[0]


def match(path: Path, table: LightTable, chosen: Selected) -> tuple[list[str], str]:
    """Return the image of each light, by its name in the table or by order, and words that say which."""
    if table.names is None:
        if len(chosen.frames) != len(table.vectors):
            raise ManifestError(f"{path}: has {len(table.vectors)} lights, the folder {len(chosen.frames)} images "
                                f"({chosen.frames[0]} to {chosen.frames[-1]}): choose as many with --images")
        return list(chosen.frames), f"in the order of the images, {chosen.frames[0]} to {chosen.frames[-1]}"
    names = []
    for given in table.names:
        found = image_named(given, chosen.frames)
        if found is None:
            raise ManifestError(f"{path}: names {given}, which is no image in the folder")
        names.append(found)
    left = len(chosen.frames) - len(set(names))
    return names, "by the names in it" + (f"; {left} images without a light are left out" if left else "")
