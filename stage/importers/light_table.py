"""Tables of lights: rows of CSV and text files, arrays of .mat and .npy files, and lists of JSON files."""

import csv
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stage.errors import ManifestError
from stage.formats import images
from stage.formats.csv_table import with_point
from stage.formats.mat_file import read_mat_arrays
from stage.importers.layout import first_of, read_json, read_lines
from stage.model import name_fault
from stage.tof.raw_frames import read_array

SUFFIXES = (".csv", ".txt", ".tsv", ".mat", ".npy", ".json", ".lp", ".dat")
NAME_KEYS = ("image", "file", "filename", "name", "img")
VECTOR_KEYS = ("direction", "position", "vector", "light", "dir", "pos", "xyz", "l")
STRENGTH_KEYS = ("intensity", "irradiance", "strength", "rgb", "colour", "color")
"""Keys and headings of a light, in small letters, in order of preference."""
LIST_KEYS = ("lights", "directions", "positions", "light_directions", "light_positions")
MOST = 1e300
"""Numbers from here on are no lights; JSON has integers of any length."""
NUMBER_KEYS = ("id", "index", "idx", "i", "number", "num", "no", "no.", "nr", "nr.", "#", "n", "light", "led", "lamp", "frame")
"""Headings of a column that numbers the lights."""
COMMENTS = ("#", "%", "//")
FLAT, HALF_TURN = 0.2, 180.0
"""The length of a column that does not change, relative to that of the vectors, below which it is a radius beside two angles, and degrees
above which a column without negative numbers is an azimuth, however long the radius beside it."""
ROUND, QUARTER = 2 * np.pi, np.pi / 2 + 0.01
"""Most that azimuths and elevations in radians are, the second rounded up; azimuths of a dome span three quarters of a turn or more."""
WHOLE, FRACTION, THOUSANDS = re.compile(r"-?\d+"), re.compile(r"0\d+"), re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
"""A whole number, what stands behind a decimal comma as no whole number does, and what a comma may part into thousands."""

Run = str
"""`rows` or `columns`: which are the lights of a table of numbers."""


class LightTable(NamedTuple):
    """The lights of a table, in its own axes."""

    names: tuple[str, ...] | None
    """The image of each light; None where the table names none."""
    vectors: np.ndarray  # [lights, 3] float64
    strengths: np.ndarray | None  # [lights, 3] float64, red, green and blue
    run: Run
    what: str
    """The file, and the variable in it where it has several, for messages."""


def read_light_table(path: Path, *, variable: str | None = None, run: Run | None = None) -> LightTable:
    """Read a table of lights.
    `path`: a .csv, .txt, .tsv, .lp or .dat file with a light in each row: an image name or none, three numbers, and one or three numbers of
    its strength or none, with a line of headings or none; a .mat or .npy file with an array of three numbers for each light; or a .json
    file with a list of lights or an object of lights by image name. `variable`: the variable of a .mat file, or the key of a JSON object;
    None: the only one that can be meant. `run`: whether lights are rows or columns of a table of numbers; None: as its shape says."""
    suffix = path.suffix.lower()
    if suffix == ".mat":
        name, values = _variable(path, read_mat_arrays(path), variable)
        return _numbers(values, run, f"{path}: {name}")
    if suffix == ".npy":
        return _numbers(read_array(path), run, str(path))
    if suffix == ".json":
        return _from_json(path, variable, run)
    if suffix not in SUFFIXES:
        raise ManifestError(f"{path}: is no table of lights: its suffix must be one of {', '.join(SUFFIXES)}")
    return _from_text(path, run)


def read_strengths(path: Path) -> np.ndarray:
    """Read the strength of each light from a file of its own: rows of one or three numbers. Returns [lights, 3] float64."""
    if path.suffix.lower() == ".mat":
        name, values = _variable(path, read_mat_arrays(path), None, sides=(1, 3))
        return _strengths(np.asarray(values, dtype=np.float64), f"{path}: {name}")
    _, rows, _ = read_rows(path)
    try:
        values = np.array([list(map(float, row)) for _, row in rows])
    except ValueError as error:
        raise ManifestError(f"{path}: must hold one or three numbers for each light") from error
    return _strengths(values, str(path))


def _strengths(values: np.ndarray, what: str) -> np.ndarray:
    values = values.reshape(-1, 1) if values.ndim == 2 and 1 in values.shape else values
    if values.ndim != 2 or values.shape[1] not in (1, 3) or not np.isfinite(values).all():
        raise ManifestError(f"{what}: must hold one or three finite numbers for each light")
    return np.broadcast_to(values, (len(values), 3)).copy()


def _variable(path: Path, arrays: Mapping[str, np.ndarray], wanted: str | None, sides: tuple[int, ...] = (3,)) -> tuple[str, np.ndarray]:
    """Return the array that is meant: the one that was named, or the only one that has a side of three."""
    if wanted is not None:
        if wanted not in arrays:
            raise ManifestError(f"{path}: holds no array {wanted}, but {', '.join(arrays) or 'none at all'}")
        return wanted, arrays[wanted]
    fitting = {name: values for name, values in arrays.items() if values.ndim == 2 and set(values.shape) & set(sides)}
    if len(fitting) != 1:
        held = ", ".join(f"{name} ({' x '.join(map(str, values.shape))})" for name, values in arrays.items())
        raise ManifestError(f"{path}: holds {held or 'no array'}: " + (
            "name that of the lights with --variable" if fitting else f"there must be {sides[-1]} numbers for each light"))
    return next(iter(fitting.items()))


def _numbers(values: np.ndarray, run: Run | None, what: str) -> LightTable:
    """Return the lights of an array of numbers without names."""
    if values.ndim != 2 or values.dtype.kind not in "fiu" or 3 not in values.shape:
        raise ManifestError(f"{what}: is {' x '.join(map(str, values.shape))}: give three numbers for each light")
    if run is None:
        if values.shape == (3, 3):
            raise ManifestError(f"{what}: is 3 x 3: say with --lights-in whether its rows or its columns are the lights")
        run = "rows" if values.shape[1] == 3 else "columns"
    vectors = np.asarray(values if run == "rows" else values.T, dtype=np.float64)
    if vectors.shape[1] != 3:
        raise ManifestError(f"{what}: is {' x '.join(map(str, values.shape))}: its {run} do not have three numbers each")
    return _checked(LightTable(None, vectors, None, run, what), lambda index: f"{what}: light {index + 1}")


def _checked(table: LightTable, place: Callable[[int], str]) -> LightTable:
    """Refuse a light without a direction, which `place` names, and angles."""
    check_angles(table.vectors, table.what)
    for index, vector in enumerate(table.vectors):
        if not np.isfinite(vector).all() or not vector.any():
            raise ManifestError(f"{place(index)}: {' '.join(f'{value:g}' for value in vector)} is no direction and no position")
    seen: set[str] = set()
    for index, name in enumerate(table.names or ()):
        if (fault := name_fault(name)) is not None:
            raise ManifestError(f"{place(index)}: the image name {ascii(name)[1:-1][:60]} {fault}")
        if name in seen:
            raise ManifestError(f"{place(index)}: names {name} a second time: each light has an image of its own")
        seen.add(name)
    return table


def read_rows(path: Path) -> tuple[list[str] | None, list[tuple[int, list[str]]], int | None]:
    """Return the headings of a text file in small letters, the number and parts of each line, and the count in its first line."""
    lines = [(number, line.partition(" #")[0]) for number, line in read_lines(path) if not line.startswith(COMMENTS)]
    separator = _separator([line for _, line in lines])
    fewest = min((numbers for _, line in lines if (numbers := _numbers_at_end(line)) > 2), default=0)

    def split(line: str) -> list[str]:
        numbers = _numbers_at_end(line)
        numbers = numbers if numbers == len(line.split()) else min(numbers, fewest)  # a name before them may hold spaces and numbers
        parts = (line.rsplit(maxsplit=numbers) if numbers else line.split()) if separator is None else (
            next(csv.reader([line], delimiter=separator, skipinitialspace=True)))
        return [part.strip().strip('"').strip("'") for part in parts]

    rows = [(number, split(line)) for number, line in lines]
    commas = [part for _, parts in rows for part in parts if with_point(part) != part]
    if commas and all(map(THOUSANDS.fullmatch, commas)):
        raise ManifestError(f"{path}: holds {commas[0]}, which may be a thousand or have decimals: write numbers with points and without "
                            "marks of thousands")
    rows = [(number, [with_point(part) for part in parts]) for number, parts in rows]
    count = None
    if len(rows) > 1 and len([part for part in rows[0][1] if part]) == 1 and rows[0][1][0].isdecimal() and len(rows[1][1]) > 1:
        count, rows = int(rows[0][1][0]), rows[1:]
    headed = bool(rows) and len(rows[0][1]) > 1 and not any(_number(part) is not None for part in rows[0][1])
    headings, rows = ([part.lower() for part in rows[0][1]], rows[1:]) if headed else (None, rows)
    for number, parts in rows:
        whole = [part for part in parts if _number(part) is not None]
        if any(parts[len(headings):]) if headings else len(whole) in (6, 7) and all(map(WHOLE.fullmatch, whole)) and any(
                map(FRACTION.fullmatch, whole)):
            raise ManifestError(f"{path}: line {number}: has {len(parts)} cells" + (f" under {len(headings)} headings" if headings else "")
                                + ": part columns by semicolons where numbers have decimal commas")
    return headings, rows, count


def _separator(lines: list[str]) -> str | None:
    """Return what parts the columns of most lines; None: white space."""
    for mark in ";\t":
        if 2 * sum(line.count(mark) > 1 for line in lines) >= len(lines) > 0:
            return mark
    decimal = sum(_numbers_at_end(line) in (len(line.split()), *range(3, 8)) for line in lines)  # commas are then within numbers
    return None if 2 * decimal > len(lines) or not any("," in line for line in lines) else ","


def _numbers_at_end(line: str) -> int:
    """Return how many numbers a line ends with, between white space."""
    words = line.split()
    return next((count for count, word in enumerate(reversed(words)) if _number(with_point(word)) is None), len(words))


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _from_text(path: Path, run: Run | None) -> LightTable:
    headings, rows, count = read_rows(path)
    if not rows:
        raise ManifestError(f"{path}: holds no light")
    named = None if headings is None else _named(headings, rows)
    rows = _without_numbers(path, headings, rows, named)
    table = _without_headings(path, rows, run) if headings is None else _with_headings(path, headings, rows, named)
    if table.strengths is not None and len(rows) > 3 and any((table.strengths[:, 0] == np.arange(len(rows)) + first).all()
                                                             for first in (0, 1)):
        table = table._replace(strengths=None)  # a column that numbers the lights
    if count is not None and count != len(table.vectors):
        raise ManifestError(f"{path}: says {count} lights, holds {len(table.vectors)}")
    return _checked(table, (lambda index: f"{path}: line {rows[index][0]}") if table.run == "rows" else
                    (lambda index: f"{path}: column {index + 1}"))


def _named(headings: list[str], rows: list[tuple[int, list[str]]]) -> int | None:
    """Return the column of the names of images: that of their heading, or in which every row has the suffix of an image; else None."""
    told = (index for index, heading in enumerate(headings) if heading in NAME_KEYS)
    seen = (index for index in range(len(headings)) if all(Path("".join(parts[index:index + 1])).suffix.lower() in images.SUFFIXES
                                                           for _, parts in rows))
    return next(told, next(seen, None))


def _without_numbers(path: Path, headings: list[str] | None, rows: list[tuple[int, list[str]]], named: int | None
                     ) -> list[tuple[int, list[str]]]:
    """Return rows without a first column that numbers the lights; under headings it stays, and is not read.
    Raises ManifestError where a column numbers them in another order: nothing says whether images come in the order of rows or numbers."""
    if headings is None:
        columns = [0] if len(rows) > 3 and all(len(parts) == len(rows[0][1]) in (4, 5, 7) for _, parts in rows) else []
    else:
        columns = [] if named is not None else [index for index, heading in enumerate(headings) if heading in NUMBER_KEYS]
    for column in columns:
        texts = [parts[column] if column < len(parts) else "" for _, parts in rows]
        numbers = [int(text) for text in texts if text.isdecimal() and len(text) < 7]
        if len(numbers) < len(rows):
            continue
        if sorted(numbers) not in (list(range(len(rows))), list(range(1, len(rows) + 1))):
            others = [part for _, parts in rows for part in parts[1:]]
            if headings is None and numbers == sorted(set(numbers)) and not all(map(WHOLE.fullmatch, others)):
                raise ManifestError(f"{path}: its first column numbers the lights {', '.join(texts[:4])} … with gaps: name the image of "
                                    "each light, or leave the column out")
            continue
        if numbers != sorted(numbers):
            raise ManifestError(f"{path}: numbers its lights {', '.join(texts[:4])} …: put the rows into the order of the images, or name "
                                "the image of each light")
        if headings is None:
            return [(number, parts[1:]) for number, parts in rows]
    return rows


def check_angles(vectors: np.ndarray, what: str) -> None:
    """Refuse two angles, in degrees or radians, beside a radius, as vectors [lights, 3]. `what`: the file, for the message."""
    for radius, angles in ((0, (1, 2)), (0, (2, 1)), (2, (0, 1)), (2, (1, 0))) if len(vectors) > 3 else ():
        length, given = vectors[:, radius], vectors[:, angles]
        turn, height = np.abs(given).T
        told = np.ptp(length) == 0 < np.ptp(height)
        degrees = 90 < turn.max() <= 360 and height.max() <= 90 and (
            length[0] < FLAT * float(np.median(np.hypot(turn, height))) or (given.min() >= 0 and turn.max() > HALF_TURN))
        radians = np.ptp(given[:, 0]) > 0.75 * ROUND and turn.max() <= ROUND and given[:, 1].min() >= 0 and height.max() <= QUARTER
        if told and (degrees or radians):
            raise ManifestError(f"{what}: its columns look like two angles and a radius of {length[0]:g}: there must be x, y and z "
                                "of each light")


def _with_headings(path: Path, headings: list[str], rows: list[tuple[int, list[str]]], name: int | None) -> LightTable:
    def column(pattern: str) -> int | None:
        return next((index for index, heading in enumerate(headings) if re.fullmatch(pattern, heading)), None)

    vector = [column(rf"(l|d|p|n|light|dir|direction|pos|position)?[ _.]?{axis}([ _]?\(?\[?(mm|cm|m)?\)?\]?)?") for axis in "xyz"]
    strength = [column(rf"({letter}|{word}|(intensity|irradiance|i)[ _.]?({letter}|{word}))")
                for letter, word in (("r", "red"), ("g", "green"), ("b", "blue"))]
    single = column("|".join((*STRENGTH_KEYS, "i")))
    if None in vector:
        raise ManifestError(f"{path}: has the headings {', '.join(headings)}: there must be x, y and z of each light")
    if None in strength:
        strength = [single] * 3
    vectors, strengths, names = [], [], []
    for number, parts in rows:
        wanted = [*vector, *(strength if single is not None or strength[0] is not None else [])]
        values = [_number(parts[index]) if index is not None and index < len(parts) else None for index in wanted]
        if any(value is None for value in values) or (name is not None and (name >= len(parts) or not parts[name])):
            raise ManifestError(f"{path}: line {number}: {' '.join(parts)[:60]!r} lacks a value of {', '.join(headings)}")
        vectors.append(values[:3])
        strengths.append(values[3:])
        names.append(parts[name] if name is not None else "")
    return LightTable(tuple(names) if name is not None else None, np.array(vectors, dtype=np.float64),
                      np.array(strengths, dtype=np.float64) if strengths[0] else None, "rows", str(path))


def _without_headings(path: Path, rows: list[tuple[int, list[str]]], run: Run | None) -> LightTable:
    named = _number(rows[0][1][0]) is None
    parsed = []
    for number, parts in rows:
        read = [_number(part) for part in (parts[1:] if named else parts) if part]
        row = [value for value in read if value is not None]
        if len(row) < len(read) or not row:
            raise ManifestError(f"{path}: line {number}: {' '.join(parts)[:60]!r} is not "
                                f"{'an image name and ' if named else ''}three numbers")
        parsed.append(row)
    width = len(parsed[0])
    uneven = next((number for (number, _), row in zip(rows, parsed, strict=True) if len(row) != width), None)
    if uneven is not None:
        raise ManifestError(f"{path}: line {uneven}: has another count of numbers than the first line, {width}")
    values = np.array(parsed, dtype=np.float64)
    if not named and len(values) == 3 and run is None and width in (3, 4, 6):
        raise ManifestError(f"{path}: is 3 x {width}: say with --lights-in whether its rows or its columns are the lights")
    if not named and len(values) == 3 and run != "rows":
        return LightTable(None, values.T, None, "columns", str(path))
    if run == "columns" or width not in (3, 4, 6):
        raise ManifestError(f"{path}: has {len(values)} rows of {width} numbers: a light has three, and one or three of its strength")
    strengths = values[:, 3:] if width > 3 else None
    return LightTable(tuple(parts[0] for _, parts in rows) if named else None, values[:, :3],
                      None if strengths is None else np.broadcast_to(strengths, (len(values), 3)).copy(), "rows", str(path))


def _from_json(path: Path, variable: str | None, run: Run | None) -> LightTable:
    data = read_json(path)
    if isinstance(data, dict):
        key = variable or next((key for key in LIST_KEYS if key in data), None)
        if variable is not None and variable not in data:
            raise ManifestError(f"{path}: has no key {variable}, but {', '.join(map(str, data))[:200]}")
        data = data if key is None else data[key]
    entries = list(data.items()) if isinstance(data, dict) else [(None, entry) for entry in data] if isinstance(data, list) else []
    if not entries:
        raise ManifestError(f"{path}: holds no list of lights" + ("" if variable else ": name its key with --variable"))
    if isinstance(data, list) and all(isinstance(entry, list) and all(isinstance(value, int | float) and abs(value) < MOST
                                                                      for value in entry) for entry in data):
        if len({len(entry) for _, entry in entries}) > 1:
            raise ManifestError(f"{path}: its lights have different counts of numbers")
        return _numbers(np.array([entry for _, entry in entries], dtype=np.float64), run, str(path))
    lights = [_light(path, index, key, entry) for index, (key, entry) in enumerate(entries)]
    names = [name for name, _, _ in lights]
    strengths = [strength for _, _, strength in lights if strength is not None]
    if (any(names) and not all(names)) or len(strengths) not in (0, len(lights)):
        raise ManifestError(f"{path}: some lights have an image or a strength and others have none: give all, or none")
    return _checked(LightTable(tuple(map(str, names)) if all(names) else None, np.array([vector for _, vector, _ in lights]),
                               np.array(strengths) if strengths else None, "rows", str(path)),
                    lambda index: f"{path}: light {index + 1}")


def _light(path: Path, index: int, key: str | None, entry: Any) -> tuple[str | None, list[float], list[float] | None]:
    """Return the image, the vector and the strength of an entry of a JSON list."""
    if isinstance(entry, list):
        entry = {"vector": entry}
    if not isinstance(entry, dict):
        raise ManifestError(f"{path}: light {index + 1} is {str(entry)[:60]}: give a list of three numbers, or an object")
    small = {str(name).lower(): value for name, value in entry.items()}
    vector = first_of(small, VECTOR_KEYS)
    if vector is None or isinstance(vector, dict):
        vector = [(vector or small).get(axis) for axis in "xyz"]
    strength = first_of(small, STRENGTH_KEYS)
    strength = [strength] * 3 if isinstance(strength, int | float) else strength
    for what, values in (("direction or position", vector), ("strength", strength)):
        if values is not None and not (isinstance(values, list) and len(values) == 3
                                       and all(isinstance(value, int | float) and abs(value) < MOST for value in values)):
            raise ManifestError(f"{path}: light {index + 1}: its {what} is {str(values)[:60]}: give three numbers")
    name = key or first_of(small, NAME_KEYS)
    return (None if name is None else str(name)), [float(value) for value in vector], strength
