"""Import of images of the stripe of a laser, one for each place of its plane, with the planes in a file or without.

A file of planes has rows of coefficients or of a point and a normal, or is a calibration file with entries of them.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import ManifestError
from stage.formats.images import SUFFIXES as IMAGE_SUFFIXES
from stage.formats.mat_file import read_mat_arrays
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
from stage.importers.layout import (
    Imported,
    assumed_encoding,
    color_space_of,
    first_of,
    image_named,
    image_names,
    image_resolution,
    read_json,
    write_capture,
)
from stage.importers.light_table import read_rows
from stage.importers.opencv_file import read_matrices
from stage.tof.raw_frames import read_array

NAMES = ("laser_planes", "planes", "laser_plane", "laserPlane", "plane", "plane_coefficients", "plane_params", "laser", "coefficients")
"""Names of the planes in calibration files, in order of preference."""
NORMALS, DISTANCES, POINTS = ("normal", "normals", "n"), ("distance", "d", "offset"), ("point", "points", "origin")
"""Names of the parts of one plane, or of all."""
TEXT = (".csv", ".txt", ".tsv", ".dat")
FORMS = {"zero": "a x + b y + c z + d = 0", "equals": "a x + b y + c z = d"}
"""Meanings of the four coefficients of a plane."""
OFF_WORDS = AMBIENT_WORDS | {"background", "off", "nolaser"}
"""Words in the name of the image without the laser."""
PLACEHOLDER: dict[str, Any] = {"type": "plane", "point_m": [0, 0, 0], "normal": [1, 0, 0]}
"""The plane of a frame that relit calibrate laser-planes is to measure."""


class PlaneTable(NamedTuple):
    """The planes of a file, in its own axes and unit."""

    values: np.ndarray
    """[planes, 4] float64, coefficients a, b, c, d; or [planes, 6], a point and the normal."""
    names: tuple[str, ...] | None
    """The image of each plane, where the file names them."""

    def points_and_normals(self, form: str | None, path: Path) -> tuple[np.ndarray, np.ndarray]:
        """Return a point of each plane and its unit normal, [planes, 3] float64 each.
        `form`: one of FORMS, for coefficients; None: not told."""
        normals = self.values[:, :3] if self.values.shape[1] == 4 else self.values[:, 3:]
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        if (length == 0).any():
            raise ManifestError(f"{path}: plane {int(np.argmin(length)) + 1}: its normal is zero")
        if self.values.shape[1] == 6:
            return self.values[:, :3], normals / length
        if form is None:
            raise ManifestError(f"{path}: holds four coefficients of each plane: say what they mean, "
                                + " or ".join(f"--form {name} for {words}" for name, words in FORMS.items()))
        along = self.values[:, 3:] / length * (-1 if form == "zero" else 1)
        return normals / length * along, normals / length


def read_planes(path: Path) -> PlaneTable:
    """Read the planes of a file.
    `path`: text or CSV with a row for each plane, an image name before it or none; .npy or .mat with such an array; or a calibration file
    of OpenCV or JSON (.yml, .xml, .json) with one of NAMES, or with a normal and a distance or a point."""
    suffix = path.suffix.lower()
    if suffix in TEXT:
        return _from_text(path)
    if suffix == ".npy":
        return _table(path, read_array(path), None)
    if suffix == ".json":
        objects = _objects(path)
        if objects is not None:
            return objects
    matrices = read_mat_arrays(path) if suffix == ".mat" else read_matrices(path)
    return _of_parts(path, matrices)


def _from_text(path: Path) -> PlaneTable:
    found, names = [], []
    _, rows, _ = read_rows(path)
    for number, parts in rows:
        name = parts[0] if Path(parts[0]).suffix.lower() in IMAGE_SUFFIXES else None
        try:
            values = [float(part) for part in (parts if name is None else parts[1:]) if part]
        except ValueError:
            values = []
        if len(values) not in (4, 6):
            raise ManifestError(f"{path}: line {number}: {' '.join(parts)[:60]!r} is no plane: give four coefficients, or a point and a "
                                "normal")
        found.append(values)
        names += [] if name is None else [name]
    if not found:
        raise ManifestError(f"{path}: holds no planes: give a row of four coefficients for each, or of a point and a normal")
    if len({len(row) for row in found}) > 1 or len(names) not in (0, len(found)):
        raise ManifestError(f"{path}: its rows differ: each has four numbers or each has six, and all have an image name or none")
    return _table(path, np.array(found), tuple(names) or None)


def _objects(path: Path) -> PlaneTable | None:
    """Return the planes of a list of objects in a JSON file; None where it holds something else."""
    data = read_json(path)
    if isinstance(data, dict):
        data = next((data[name] for name in NAMES if isinstance(data.get(name), dict | list)), data)
    planes: list[Any] = [data] if isinstance(data, dict) else data if isinstance(data, list) else []
    if not planes or not all(isinstance(plane, dict) and any(name in plane for name in NORMALS) for plane in planes):
        return None
    try:
        parts = [{str(key): np.atleast_1d(np.array(value, np.float64)) for key, value in plane.items()
                  if key in (*NORMALS, *DISTANCES, *POINTS)} for plane in planes]
    except (TypeError, ValueError) as error:
        raise ManifestError(f"{path}: its planes must have numbers as normal and as distance or point") from error
    tables = [_of_parts(path, held) for held in parts]
    images = [next((str(plane[key]) for key in ("image", "file", "name") if key in plane), None) for plane in planes]
    names = tuple(image for image in images if image is not None)
    if len({table.values.shape[1] for table in tables}) > 1 or len(names) not in (0, len(planes)):
        raise ManifestError(f"{path}: its planes differ: each has a distance or each has a point, and all name an image or none")
    return PlaneTable(np.concatenate([table.values for table in tables]), names or None)


def _of_parts(path: Path, matrices: dict[str, np.ndarray]) -> PlaneTable:
    """Return the planes that a calibration file holds under the usual names."""
    whole = first_of(matrices, NAMES)
    if whole is not None:
        return _table(path, whole, None)
    normal, distance, point = (first_of(matrices, names) for names in (NORMALS, DISTANCES, POINTS))
    if normal is None or (distance is None and point is None):
        raise ManifestError(f"{path}: holds {', '.join(matrices) or 'nothing'}: there must be the planes of the laser, as "
                            f"{', '.join(NAMES[:3])}, or as normal and distance or point")
    try:
        normals = normal.reshape(-1, 3)
        if point is not None:
            return _table(path, np.hstack([point.reshape(-1, 3), normals]), None)
        assert distance is not None
        return _table(path, np.hstack([normals, distance.reshape(-1, 1)]), None)
    except ValueError as error:
        raise ManifestError(f"{path}: its planes need a normal of three numbers each, and as many distances or points") from error


def _table(path: Path, values: np.ndarray, names: tuple[str, ...] | None) -> PlaneTable:
    table = np.asarray(values, np.float64)
    table = table.reshape(1, -1) if table.ndim < 2 or table.shape in ((4, 1), (6, 1)) else table
    if table.ndim != 2 or table.shape[1] not in (4, 6) or not np.isfinite(table).all():
        raise ManifestError(f"{path}: holds {' x '.join(map(str, np.shape(values)))} numbers: planes are rows of four coefficients, or of "
                            "a point and a normal, all finite")
    return PlaneTable(table, names)


def import_folder(source: Path, destination: Path, *, view: View, camera: Path | None = None, planes: Path | None = None,
                  form: str | None = None, axes: Axes | None = None, unit_m: float | None = None, selection: Selection | None = None,
                  color_space: ColorSpaceName | None = None) -> Imported:
    """Write a capture.json for images under one laser plane each.

    Args:
        planes: the file of the planes; None: every frame gets a placeholder.
        form: what four coefficients of a plane mean, one of `FORMS`.
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
        "name": source.resolve().name, "color_space": space, "camera": view.entry(resolution), "mask": chosen.mask,
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
        found = [image_named(name, names) for name in table.names]
        if None in found or len(set(found)) < len(found):
            raise ManifestError(f"{path}: {table.names[found.index(None)] if None in found else 'an image'} "
                                + ("is not among the images" if None in found else "is named twice"))
        left = f"; {len(names) - count} other images are left out" if count < len(names) else ""
        return [names.index(name) for name in found if name is not None], f"matched by the names in the file{left}"
    if count == 1 < len(names):
        raise ManifestError(f"{path}: holds one plane, and there are {len(names)} images ({names[0]} to {names[-1]}): the scene of a "
                            "capture stands still, so that each image has a plane of its own: choose one image with --images")
    if count != len(names):
        raise ManifestError(f"{path}: holds {count} planes, and there are {len(names)} images ({names[0]} to {names[-1]}): choose these "
                            "with --images")
    return list(range(count)), f"in the order of the images, {names[0]} to {names[-1]}"
