"""Import of RelightLab's projects (.relight) and domes (.dome), which are JSON files.

A project names its images, those to skip, and the folder that they lie in; a dome has the lights alone, in the order of the images. The
axes are those of .lp files: x right, y up, z towards the camera, and vectors point to the light. `ledAdjust` is the factor that readings
are multiplied with, so that a light's irradiance is its reciprocal. Positions are in millimetres from the centre of the image, whose width
is `imageWidth`.

Source: the program's Project and Dome classes (Visual Computing Lab, ISTI-CNR).
"""

from pathlib import Path
from typing import Any

import numpy as np

from stage import inputs
from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import ManifestError, storage
from stage.importers.camera_options import Selection, select
from stage.importers.layout import Imported, assumed_encoding, color_space_of, image_resolution, read_json, write_capture
from stage.model import name_fault

SUFFIXES = (".relight", ".dome")
POSITIONS = {"spherical": "positionsSphere", "lights3d": "positions3d"}
"""lightConfiguration of near lights → key of their positions."""
MM, MOST_MM = 0.001, 1e9


def import_folder(source: Path, destination: Path | None, *, color_space: ColorSpaceName | None = None) -> Imported:
    """Write a capture.json for a project or a dome of RelightLab.
    `source`: a .relight or .dome file, or a folder with exactly one of them. `destination`: the folder of the capture, which gets links to,
    or copies of, the images; None: the folder of the images. `color_space`: that of the images; None: by their depth."""
    path = _find(source)
    data = _read(path)
    dome = data.get("dome", {}) if path.suffix.lower() == ".relight" else data
    if not isinstance(dome, dict):
        raise ManifestError(f"{path}: dome: must be an object")
    if path.suffix.lower() == ".relight":
        folder, entries = _project(path, data)
    else:
        folder = path.parent
        entries = [{"filename": name} for name in select(folder, Selection()).frames]
    used = [entry for entry in entries if not entry.get("skip")]
    if not used:
        raise ManifestError(f"{path}: names no image that is not skipped")
    names = [str(entry["filename"]) for entry in used]
    near = POSITIONS.get(str(dome.get("lightConfiguration", "")))
    width_mm = _number(path, dome, "imageWidth")
    near = near if near and width_mm > 0 else None
    vectors = _of_images(path, dome, near or "directions", "xyz", entries)
    if vectors is None and near is None:
        if str(dome.get("lightConfiguration", "")) in POSITIONS and not all(entry.get("direction") for entry in used):
            raise ManifestError(f"{path}: dome.imageWidth: is not set, which positions of near lights need: set it in RelightLab")
        vectors = _vectors(path, "images[].direction", [entry.get("direction") for entry in used], "xyz")
    if vectors is None:
        raise ManifestError(f"{path}: dome.{near}: is missing or does not have one light for each image")
    for name, vector in zip(names, vectors, strict=True):
        if not vector.any():
            raise ManifestError(f"{path}: {name} has no light direction: find it in RelightLab, or skip the image there")
    adjust = _of_images(path, dome, "ledAdjust", "rgb", entries)
    if adjust is not None and (adjust <= 0).any():
        raise ManifestError(f"{path}: dome.ledAdjust: holds a factor that is not above 0")
    strength = np.ones((len(names), 3)) if adjust is None else 1 / adjust
    resolution = image_resolution(folder / names[0])
    camera: dict[str, Any] = {"projection": "orthographic", "resolution": list(resolution)}
    if width_mm > 0:
        camera["pixel_size_m"] = MM * width_mm / resolution[0]
    frames = [{"image": name, "light": {"type": "point", "position_m": (MM * vector).tolist(), "intensity": power.tolist()} if near else
               {"type": "distant", "direction": vector.tolist(), "irradiance": power.tolist()}}
              for name, vector, power in zip(names, vectors, strength, strict=True)]
    space, mask = color_space or color_space_of(folder / names[0]), select(folder, Selection()).mask
    aligned = [f"frames[].image: {path.name} moves images so that they lie on one another, and they were taken as they are: align them "
               "before if they do not"] if data.get("aligns") else []
    written = write_capture({"name": path.stem, "color_space": space, "camera": camera, "mask": mask,
                             "irradiance_scale": "relative", "assumed": [*assumed_encoding(space, color_space), *aligned],
                             "frames": frames}, path, destination or folder, folder=folder)
    crop = ("crop", f"{path} crops the images; the capture has them whole") if data.get("crop") else None
    return Imported(written, tuple(fact for fact in (
        ("lights", f"{len(names)} {'near' if near else 'far'} lights from {path}, " + (
            "in the order of the images" if path.suffix.lower() == ".dome" else f"{len(entries) - len(used)} images are skipped there")),
        ("axes", "those of RelightLab: x right, y up, z towards the camera (right-handed); vectors point to the light"),
        ("strength", "equal: relit calibrate intensity measures it" if adjust is None else "the reciprocal of ledAdjust"),
        ("colour", space + ("" if color_space else ", by the depth of the images")),
        ("camera", "orthographic, " + (f"{width_mm:g} mm wide" if width_mm > 0 else "of unknown scale: imageWidth is not set")),
        ("mask", mask or "none: every pixel is taken"), crop) if fact is not None))


def _find(source: Path) -> Path:
    if source.is_file():
        if source.suffix.lower() not in SUFFIXES:
            raise ManifestError(f"{source}: is no file of RelightLab: its suffix must be .relight or .dome")
        return source
    with storage("read", source):
        found = sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
    projects = [path for path in found if path.suffix.lower() == ".relight"]
    if len(projects) == 1 or len(found) == 1:
        return (projects or found)[0]
    raise ManifestError(f"{source}: holds {len(found)} files of RelightLab (.relight, .dome): name the one to import")


def _read(path: Path) -> dict[str, Any]:
    data = read_json(path)
    if not isinstance(data, dict):
        raise ManifestError(f"{path}: must hold one JSON object")
    return data


def _project(path: Path, data: dict[str, Any]) -> tuple[Path, list[dict[str, Any]]]:
    """Return the folder of the images of a project, and its entries of images."""
    entries = data.get("images")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) and isinstance(entry.get("filename"), str) for entry in entries):
        raise ManifestError(f"{path}: images: must be a list of objects with a filename")
    for entry in entries:
        if (fault := name_fault(entry["filename"])) is not None:
            raise ManifestError(f"{path}: the image name {fault}")
    given = data.get("folder", "")
    folder = path.parent / given if isinstance(given, str) and name_fault(given) is None else path.parent
    if not inputs.is_allowed(folder):
        folder = path.parent
    first = next((entry["filename"] for entry in entries), "")
    with storage("read", folder):
        if not inputs.is_file(folder / first) and inputs.is_file(path.parent / first):
            folder = path.parent  # the project was moved together with its images
        if not folder.is_dir():
            raise ManifestError(f"{path}: folder: {given} is not there: put the project beside its images")
    return folder, entries


def _of_images(path: Path, dome: dict[str, Any], key: str, parts: str, entries: list[dict[str, Any]]) -> np.ndarray | None:
    """Return the values of a list of the dome for the images that are not skipped; None where it has none or not one for each image."""
    values = dome.get(key)
    if not isinstance(values, list) or not values:
        return None
    kept = [index for index, entry in enumerate(entries) if not entry.get("skip")]
    if len(values) == len(entries):
        values = [values[index] for index in kept]
    elif len(values) != len(kept):
        raise ManifestError(f"{path}: dome.{key}: has {len(values)} entries for {len(entries)} images, {len(kept)} of them not skipped")
    return _vectors(path, f"dome.{key}", values, parts)


def _vectors(path: Path, field: str, values: list[Any], parts: str) -> np.ndarray:
    try:
        found = np.array([[float(value[part]) for part in parts] for value in values], dtype=np.float64)
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise ManifestError(f"{path}: {field}: each must have the numbers {', '.join(parts)}") from error
    if not np.isfinite(found).all():
        raise ManifestError(f"{path}: {field}: holds a number that is not finite")
    return found


def _number(path: Path, dome: dict[str, Any], key: str) -> float:
    value = dome.get(key, 0.0)
    if not isinstance(value, int | float) or not 0 <= value < MOST_MM:
        raise ManifestError(f"{path}: dome.{key}: is {str(value)[:60]}: must be a number, 0 or above")
    return float(value)
