"""Import of images of the stripe of a laser, one for each place of its plane, with the planes in a file or without."""

from pathlib import Path
from typing import Any

import numpy as np

from stage.capture.manifest import SCHEMA
from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import ManifestError
from stage.importers.camera_options import (
    AMBIENT_WORDS,
    Axes,
    Selection,
    View,
    camera_from_table,
    describe,
    only_image,
    select,
    view_of_file,
)
from stage.importers.layout import Imported, assumed_encoding, color_space_of, image_names, image_resolution, write_capture
from stage.importers.plane_table import PlaneTable, read_planes

OFF_WORDS = AMBIENT_WORDS | {"background", "off", "nolaser"}
"""Words in the name of the image without the laser."""
PLACEHOLDER: dict[str, Any] = {"type": "plane", "point_m": [0, 0, 0], "normal": [1, 0, 0]}
"""The plane of a frame that relit calibrate laser-planes is to measure."""


def import_folder(source: Path, destination: Path, *, view: View, camera: Path | None = None, planes: Path | None = None,
                  form: str | None = None, axes: Axes | None = None, unit_m: float | None = None, selection: Selection | None = None,
                  color_space: ColorSpaceName | None = None) -> Imported:
    """Write a capture.json for images under one laser plane each.

    Args:
        view: the camera, as far as options say it.
        planes: the file of the planes; None: every frame gets a placeholder.
        form: what four coefficients of a plane mean, one of `plane_table.FORMS`.
        axes: where x, y and z of the planes point, as seen by the camera, whose centre is their origin; needed with `planes`.
        unit_m: the metres in one unit of the planes; needed with `planes`.
        selection: which images are frames; None: all but the mask and the one without the laser.
    """
    given = selection or Selection()
    off = only_image(source, image_names(source), given.ambient, OFF_WORDS, "ambient")
    chosen = select(source, Selection(images=given.images, mask=given.mask, ambient=off))
    names = list(chosen.frames)
    resolution = image_resolution(source / names[0])
    view, camera_words = view_of_file(view, camera, resolution)
    if view.focal_px is None:
        raise ManifestError(f"{source}: lines of sight of a laser capture need a calibrated perspective camera: give --camera FILE or "
                            "--focal-px")
    lasers: list[dict[str, Any]] = [PLACEHOLDER] * len(names)
    facts = [("lasers", f"{len(names)} images, {names[0]} to {names[-1]}, with placeholders: relit calibrate laser-planes measures the "
                        "planes")]
    if planes is not None:
        assert axes is not None and unit_m is not None
        table = read_planes(planes)
        point, normal = table.points_and_normals(form, planes)
        order, words = _matched(planes, table, names)
        names = [names[index] for index in order]
        matrix = camera_from_table(axes)
        point, normal = unit_m * point @ matrix.T, normal @ matrix.T
        lasers = [{"type": "plane", "point_m": p, "normal": n} for p, n in zip(point.tolist(), normal.tolist(), strict=True)]
        away = np.abs((point * normal).sum(axis=1))
        facts = [("lasers", f"{len(names)} planes from {planes}, {words}"), ("axes", f"{describe(axes)}, from the centre of the camera"),
                 ("places", f"the planes pass the camera at {away.min():.3g} to {away.max():.3g} m, which is about its distance from the "
                            "laser: if it is not, --unit-m is another")]
    space = color_space or color_space_of(source / names[0])
    frames = [{"image": name, "laser": laser} for name, laser in zip(names, lasers, strict=True)]
    frames += [] if off is None else [{"image": off, "light": {"type": "off"}}]
    written = write_capture({
        "schema": SCHEMA, "name": source.resolve().name, "color_space": space, "camera": view.entry(resolution), "mask": chosen.mask,
        "assumed": assumed_encoding(space, color_space), "frames": frames}, planes or source, destination, folder=source)
    return Imported(written, (
        *facts, ("without", f"{off} shows the scene without the laser" if off else
                            "no image without the laser: the least of all images is taken, of three or more"),
        ("colour", space + ("" if color_space else ", by the depth of the images: --color-space says another")), ("camera", camera_words),
        ("mask", chosen.mask or "none: every pixel is taken")))


def _matched(path: Path, table: PlaneTable, names: list[str]) -> tuple[list[int], str]:
    """Return which image each plane belongs to, and how it was found."""
    count = len(table.values)
    if table.names is not None:
        stems = {Path(name).stem.lower(): index for index, name in enumerate(names)}
        order = [stems.get(Path(name).stem.lower(), -1) for name in table.names]
        if -1 in order or len(set(order)) < len(order):
            raise ManifestError(f"{path}: {table.names[order.index(-1)] if -1 in order else 'an image'} "
                                + ("is not among the images" if -1 in order else "is named twice"))
        left = f"; {len(names) - count} other images are left out" if count < len(names) else ""
        return order, f"matched by the names in the file{left}"
    if count == 1 < len(names):
        raise ManifestError(f"{path}: holds one plane, and there are {len(names)} images ({names[0]} to {names[-1]}): the scene of a "
                            "capture stands still, so that each image has a plane of its own: choose one image with --images")
    if count != len(names):
        raise ManifestError(f"{path}: holds {count} planes, and there are {len(names)} images ({names[0]} to {names[-1]}): choose these "
                            "with --images")
    return list(range(count)), f"in the order of the images, {names[0]} to {names[-1]}"
