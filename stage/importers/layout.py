"""The common parts of the importers: reading tables of numbers, placing images and arrays, and writing the manifest."""

import codecs
import io
import json
import math
import os
import shutil
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from pydantic import ValidationError

from stage import inputs
from stage.capture.manifest import FILE_NAME, SCHEMA, Manifest, manifest_text, write_manifest
from stage.colour.colour_spaces import NAMES, ColorSpaceName
from stage.errors import ManifestError, storage
from stage.files import replacing
from stage.folders import natural_order
from stage.formats import images
from stage.records import describe

T = TypeVar("T")

PREVIOUS_NAME = "capture.previous.json"
"""The name under which a capture.json is kept that an import replaces by another."""


def light_scale(white: float | None) -> tuple[Literal["relative", "absolute"], float]:
    """Return the irradiance_scale of a capture, and the irradiance of a light of strength 1.
    `white`: the reading of a white surface that faces such a light, which is its irradiance over π; None: nobody knows it."""
    return ("relative", 1.0) if white is None else ("absolute", math.pi * white)


MOST_DOUBLED, MOST_NAMED = 0.25, 3
"""The largest part of the lights of a table that may be there twice by mistake, and how many of them are named."""


class Imported(NamedTuple):
    """The capture that an importer wrote, and how it understood the folder."""

    path: Path
    """The manifest."""
    facts: tuple[tuple[str, str], ...]
    """Names and sentences of what was understood, for the person who asked: nothing is guessed without being shown."""


def image_names(folder: Path) -> list[str]:
    """Return the names of the images in a folder, in natural order; hidden files are left out."""
    with storage("read", folder):
        return natural_order(path.name for path in folder.iterdir()
                             if path.suffix.lower() in images.SUFFIXES and not path.name.startswith("."))


def image_named(given: str, names: Sequence[str]) -> str | None:
    """Return which of the images of a folder a table means, None where it means none: the one of its name, whatever folder stands before
    it, or else the only one of its stem, for images are converted, and written in small or capital letters."""
    last = given.replace("\\", "/").rsplit("/", 1)[-1]
    if last in names:
        return last
    by_stem = _by_stem(tuple(names))
    alike = {name for text in (Path(last).stem, last) for name in by_stem.get(_plain(text), ())}
    return alike.pop() if len(alike) == 1 else None


def _plain(text: str) -> str:
    return unicodedata.normalize("NFC", text).lower()  # macOS takes umlauts apart


@lru_cache(maxsize=2)
def _by_stem(names: tuple[str, ...]) -> dict[str, list[str]]:
    """Return names by their stems."""
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(_plain(Path(name).stem), []).append(name)
    return found


def read_text(path: Path) -> str:
    """Return the content of a text file in UTF-8, in UTF-16 with its mark or without, or in the code page of Western Windows."""
    data = inputs.read_bytes(path)
    marked = data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    two_bytes = next((name for at, name in ((1, "utf-16-le"), (0, "utf-16-be")) if data[at:4:2] == b"\0\0"), None)
    try:
        return data.decode("utf-16" if marked else two_bytes or "utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines of a text file that are not blank, without white space around them, each with its number from 1."""
    return [(number, line.strip()) for number, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]


def first_of(values: Mapping[str, T], names: Iterable[str]) -> T | None:
    """Return the value under the first of several names that there is; None where there is none."""
    return next((values[name] for name in names if name in values), None)


def read_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise ManifestError(f"{path}: is not JSON") from error


def image_resolution(path: Path) -> tuple[int, int]:
    """Return the width and height of an image, from its header."""
    header = images.read_header(path)
    return header.width, header.height


def color_space_of(path: Path) -> ColorSpaceName:
    """Return the colour space that an image declares, else sRGB (`srgb_texture`) for 8-bit integers, and scene-linear for any other."""
    header = images.read_header(path)
    declared = header.space if header.space in NAMES else ""
    return declared or ("srgb_texture" if header.eight_bits else "lin_rec709_scene")


def assumed_encoding(space: ColorSpaceName, told: ColorSpaceName | None = None) -> list[str]:
    """Return the entry `assumed` of a manifest: a sentence where 8-bit images are taken as sRGB though nobody has said it.
    `space`: that the manifest has. `told`: that was asked for; None: `color_space_of` has found it."""
    if told is not None or space != "srgb_texture":
        return []
    return ["color_space: the images have 8 bits and were taken as sRGB, which the files do not say: many cameras for measurements are "
            "linear, which is lin_rec709_scene"]


def place_images(source: Path, destination: Path, names: Sequence[str]) -> None:
    """Put files of `source` into `destination` as hard links when the file system allows it, otherwise as copies.

    Files of the same size and time that `destination` holds already stay; other files are never overwritten.
    Raises ManifestError if a file is missing, lies outside `source`, or differs from a file of its name in `destination`; then no file is
    placed."""
    wanted = []
    for name in names:
        origin, target = source / name, destination / name
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise ManifestError(f"{source}: {name} leads out of the folder")
        if not origin.is_file():
            raise ManifestError(f"{source}: {name} is not in the folder")
        if not target.exists():
            wanted.append((origin, target))
        elif not (target.samefile(origin) or _alike(origin, target)):
            raise ManifestError(f"{target}: is there already and differs from {origin}: choose another folder")
    for origin, target in wanted:
        with storage("write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(origin, target)
            except OSError:
                with replacing(target) as temporary:
                    shutil.copy2(origin, temporary)


def write_capture(data: dict[str, Any], table: Path, destination: Path, *, folder: Path | None = None,
                  arrays: Mapping[str, np.ndarray] | None = None) -> Path:
    """Check a manifest without its schema, place its images, and write it last, so that a capture.json never names files that do not exist.

    A capture.json that was there and differs is kept as PREVIOUS_NAME.
    `table`: the file that the manifest was made from; errors name it. `folder`: the folder of the images; None: that of `table`. `arrays`:
    what the .npy files of these names hold, which are written; the other files are placed."""
    try:
        manifest = Manifest.model_validate({"schema": SCHEMA, **data})
    except ValidationError as error:
        raise ManifestError(f"{table}: {describe(error)}") from error
    made = {name: _npy(array) for name, array in (arrays or {}).items()}
    for name, content in made.items():
        target = destination / name
        if target.exists() and inputs.read_bytes(target) != content:
            raise ManifestError(f"{target}: is there already and is another array: choose another folder")
    names = [name for frame in manifest.frames for name in (frame.image, *(frame.stereo.images if frame.stereo is not None else ()))
             if name not in made]
    place_images(folder or table.parent, destination, [*names, *([manifest.mask] if manifest.mask else [])])
    for name, content in made.items():
        with replacing(destination / name) as temporary:
            temporary.write_bytes(content)
    path = destination / FILE_NAME
    if path.is_file() and not _made_again(before := inputs.read_bytes(path), manifest):
        with replacing(destination / PREVIOUS_NAME) as temporary:
            temporary.write_bytes(before)
    write_manifest(manifest, path)
    return path


def _made_again(before: bytes, manifest: Manifest) -> bool:
    """Return whether a capture.json is that of this manifest, whatever was recorded as assumed after it was written."""
    try:
        assumed = Manifest.model_validate_json(before).assumed
    except ValidationError:
        return False
    return before == manifest_text(manifest.model_copy(update={"assumed": assumed})).encode()


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array))
    return buffer.getvalue()


def _alike(a: Path, b: Path) -> bool:
    first, second = a.stat(), b.stat()
    return first.st_size == second.st_size and int(first.st_mtime) == int(second.st_mtime)


def doubled_lights(labels: Sequence[str], places: Sequence[Sequence[float]], table: Path) -> list[str]:
    """Return the sentence about lights of a table that are exactly where one before is, as where a line was copied and not changed.
    Where most lights are in it twice or more, as of exposures or polarisers, nothing is said. `labels`: what names each light."""
    first: dict[tuple[float, ...], int] = {}
    pairs = [(before, index) for index, place in enumerate(places) if (before := first.setdefault(tuple(place), index)) != index]
    if not pairs or len(pairs) > MOST_DOUBLED * len(labels):
        return []
    named = ", ".join(f"{labels[before]} and {labels[index]}" for before, index in pairs[:MOST_NAMED])
    more = f" and {len(pairs) - MOST_NAMED} more" if len(pairs) > MOST_NAMED else ""
    return [f"frames[].light: {table.name} has one light for {named}{more}: check that no line was copied, or leave one of the images out"]
