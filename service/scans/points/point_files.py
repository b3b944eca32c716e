"""Reading of scans from the point files of other programs: XYZ and ASC, PTS and PTX, PCD, LAS and LAZ, E57."""

import io
import re
import warnings
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.scans.points.ply_points import colour_bytes
from stage.errors import ResultError, storage
from stage.formats.e57 import read_e57
from stage.formats.las import read_las
from stage.sets.scan_set import MOST_OFF_ROTATION
from stage.transforms import rigid_fault

UNIT_LENGTH = 0.02
"""Vectors whose lengths are 1 within this are normals."""
PCD_TYPES = {("F", 4): "<f4", ("F", 8): "<f8", ("I", 1): "i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
             ("U", 1): "u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8"}
MOST_HEADER = 4096
DECIMAL_COMMAS = re.compile(rb"NUMBER(?:[\s;]+NUMBER){2,}".replace(b"NUMBER", rb"[-+]?\d+(?:,\d+)?(?:[eE][-+]?\d+)?"))
"""A row of numbers some of which have decimal commas."""

WORDS = re.compile(r"[^\s,;\"#/]+")
"""Words of a heading, between blanks, commas, semicolons and quotes; CloudCompare begins it with two slashes."""


class PointScan(NamedTuple):
    """One scan of a file, in the unit of the file."""

    points: np.ndarray  # [n, 3] float64
    colours: np.ndarray | None = None  # [n, 3] uint8
    normals: np.ndarray | None = None  # [n, 3] float32
    viewpoint: np.ndarray | None = None  # [3] of the scanner, in the frame of the points; None: the file does not say it
    pose: np.ndarray | None = None  # [4, 4] world from scan, as the file has it; None: the file does not say it
    units_m: tuple[float, float, float] | None = None  # metres in one unit of x, y and z; None: the file does not say it


def read_point_scans(path: Path) -> list[PointScan]:
    """Read the scans of a file, one or, from PTS, PTX and E57, as many as it holds. Points that are not finite are left out.
    Raises ResultError: the file is not what its ending says, or a scan in it has no points. Raises StorageError: it cannot be read."""
    with storage("read", path), open(path, "rb") as stream:
        scans = list(READERS[path.suffix.lower()](stream, path))
    if not scans or any(not len(scan.points) for scan in scans):
        raise ResultError(f"{path}: holds {'no scan' if not scans else 'a scan without points'}")
    return scans


def _columns(stream: io.BufferedReader, path: Path) -> Iterator[PointScan]:
    """Yield the scan of rows of x, y, z, and of intensity, red, green and blue, or nx, ny and nz, where there are any; a heading, also
    one that is a comment, says which is which."""
    names: list[str] = []

    def rows() -> Iterator[bytes]:
        begun = False
        for line in stream:
            words = [] if begun else [word.partition("[")[0] for word in WORDS.findall(line.decode("utf-8-sig", "replace").lower())]
            remark = line[:1] in (b"#", b"/")
            if words[:3] == ["x", "y", "z"] or (not remark and {"x", "y", "z"} <= set(words)):
                names[:] = words
            elif not remark:
                yield line if begun else line.removeprefix(BOM_UTF8)
            begun = begun or bool(words and not remark)

    table = _table(_with_points(rows()), None, path)
    if not names or len(names) == table.shape[1]:
        yield _named(table, names) if names else _scan(table)
    elif names[:3] == ["x", "y", "z"]:
        yield _scan(table)
    else:
        raise ResultError(f"{path}: has {len(names)} columns in its heading ({' '.join(names)}) and {table.shape[1]} numbers in its rows")


def _named(table: np.ndarray, names: list[str]) -> PointScan:
    """Return the scan of a table whose columns have names."""
    def columns(*wanted: str) -> np.ndarray | None:
        return table[:, [names.index(name) for name in wanted]] if set(wanted) <= set(names) else None

    points, colours, normals = columns("x", "y", "z"), columns("r", "g", "b"), columns("nx", "ny", "nz")
    colours = columns("red", "green", "blue") if colours is None else colours
    assert points is not None
    finite = np.isfinite(points).all(axis=1)
    return PointScan(points[finite], None if colours is None else colour_bytes(colours[finite]),
                     None if normals is None else normals[finite].astype(np.float32))


def _with_points(lines: Iterator[bytes]) -> Iterator[bytes]:
    """Yield rows of numbers with decimal points and blanks between them. Their commas are decimal ones if in the first row that has any
    each stands between digits and blanks or semicolons part three numbers or more."""
    decimal = None
    for line in lines:
        if decimal is None and b"," in line:
            decimal = DECIMAL_COMMAS.fullmatch(line.strip()) is not None
        yield line.replace(b",", b"." if decimal else b" ").replace(b";", b" ")


def _pts(stream: io.BufferedReader, path: Path) -> Iterator[PointScan]:
    """Yield the scans of a PTS file, each a line with the number of its points, and then those."""
    while (count := _count(stream, path)) is not None:
        yield _scan(_table(stream, count, path))


def _ptx(stream: io.BufferedReader, path: Path) -> Iterator[PointScan]:
    """Yield the scans of a PTX file: columns, rows, the place and the axes of the scanner, and the matrix by which row vectors are
    multiplied, then the points in the frame of the scanner, which stands in its origin; places without a point are 0 0 0."""
    while (columns := _count(stream, path)) is not None:
        rows = _count(stream, path)
        heads = [line.split() for line in islice(stream, 8)]
        try:
            matrix = np.array([[float(word) for word in words] for words in heads[4:]]).T
        except ValueError:
            matrix = np.empty(0)
        if rows is None or matrix.shape != (4, 4) or not np.isfinite(matrix).all() or [len(words) for words in heads[:4]] != [3] * 4:
            raise ResultError(f"{path}: its header must have columns, rows, four lines of three numbers and four of four")
        if rigid_fault(matrix, MOST_OFF_ROTATION) is not None:
            raise ResultError(f"{path}: the matrix of a scan is no rotation and translation")
        table = _table(stream, columns * rows, path)
        yield _scan(table[table[:, :3].any(axis=1)])._replace(viewpoint=np.zeros(3), pose=matrix)


def _pcd(stream: io.BufferedReader, path: Path) -> Iterator[PointScan]:
    """Yield the scan of a PCD file, ASCII or binary; a VIEWPOINT other than that by default is where the scanner stood."""
    head: dict[str, list[str]] = {}
    while "DATA" not in head and stream.tell() < MOST_HEADER and (line := stream.readline()):
        key, *words = line.decode("ascii", "replace").split() or ["#"]
        head[key] = words
    try:
        kinds = [PCD_TYPES[kind, int(size)] for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
        counts = [int(count) for count in head.get("COUNT", ["1"] * len(kinds))]
        layout = np.dtype([(name if name != "_" else f"_{number}", kind, (count,)) for number, (name, kind, count) in
                           enumerate(zip(head["FIELDS"], kinds, counts, strict=True))])
        number, (data,) = int(head["POINTS"][0]), head["DATA"]
        viewpoint = np.array([float(word) for word in head.get("VIEWPOINT", ["0"] * 3)[:3]])
    except (KeyError, ValueError, IndexError) as error:
        raise ResultError(f"{path}: its header must have FIELDS, SIZE, TYPE, COUNT, POINTS and DATA, of known types") from error
    if data == "binary":
        values = np.fromfile(stream, dtype=layout, count=number)
        if len(values) != number:
            raise ResultError(f"{path}: is truncated: it holds {len(values)} of {number} points")
    elif data == "ascii":
        table = _table(stream, number, path)
        if table.shape[1] != sum(counts):
            raise ResultError(f"{path}: its rows have {table.shape[1]} of {sum(counts)} numbers")
        values, starts = np.empty(number, dtype=layout), np.cumsum([0, *counts])
        for name, kind, begin, end in zip(layout.names or (), kinds, starts, starts[1:], strict=False):
            values[name] = table[:, begin:end].astype(kind)
    else:
        raise ResultError(f"{path}: DATA is {data[:40]}: write it as ascii or binary")
    if missing := [name for name in "xyz" if name not in (layout.names or ())]:
        raise ResultError(f"{path}: has no field {missing[0]}")

    def columns(*names: str) -> np.ndarray | None:
        there = all(name in (layout.names or ()) for name in names)
        return np.concatenate([values[name][:, :1] for name in names], axis=1) if there else None

    normals, packed = columns("normal_x", "normal_y", "normal_z"), columns("rgb" if "rgb" in (layout.names or ()) else "rgba")
    points = np.concatenate([values[name][:, :1] for name in "xyz"], axis=1).astype(np.float64)
    finite = np.isfinite(points).all(axis=1)
    colours = None if packed is None or packed.itemsize != 4 else np.ascontiguousarray(packed).view(np.uint8)[finite, 2::-1]
    yield PointScan(points[finite], colours, None if normals is None else normals[finite].astype(np.float32),
                    viewpoint if viewpoint.any() else None)


def _las(_: io.BufferedReader, path: Path) -> Iterator[PointScan]:
    points, colours, units_m = read_las(path)
    yield PointScan(points, colours, units_m=units_m)


def _e57(_: io.BufferedReader, path: Path) -> Iterator[PointScan]:
    """Yield the scans of an E57 file; a scanner with a pose stands in the origin of its points."""
    for points, colours, pose in read_e57(path):
        finite = np.isfinite(points).all(axis=1)
        yield PointScan(points[finite], None if colours is None else colour_bytes(colours[finite]),
                        viewpoint=None if pose is None else np.zeros(3), pose=pose)


READERS: dict[str, Callable[[io.BufferedReader, Path], Iterator[PointScan]]] = {
    ".xyz": _columns, ".asc": _columns, ".pts": _pts, ".ptx": _ptx, ".pcd": _pcd, ".las": _las, ".laz": _las,
    ".e57": _e57}
"""The reader of each ending."""


def _count(stream: io.BufferedReader, path: Path) -> int | None:
    """Return the number that stands alone in the next line, or None at the end of the file."""
    for line in stream:
        words = line.split()
        if words:
            if len(words) != 1 or not words[0].isdigit():
                raise ResultError(f"{path}: must have a line with one whole number where it has {line[:40].decode('ascii', 'replace')!r}")
            return int(words[0])
    return None


def _table(lines: Iterator[bytes] | io.BufferedReader, rows: int | None, path: Path) -> np.ndarray:
    """Return rows of numbers [rows, 3 or more] float64."""
    last = [b""]

    def noted(line: bytes) -> bytes:
        last[0] = line
        return line

    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")  # which is said below
            table = np.loadtxt(map(noted, lines), dtype=np.float64, max_rows=rows, ndmin=2, comments=None)
    except (ValueError, UnicodeDecodeError) as error:
        words = last[0][:40].decode("ascii", "replace").strip()
        raise ResultError(f"{path}: must have rows of as many numbers each where it has {words!r}") from error
    if rows is not None and (len(table) != rows or not table.size):
        raise ResultError(f"{path}: is truncated: it holds {len(table)} of {rows} points")
    if table.size and table.shape[1] < 3:
        raise ResultError(f"{path}: its rows have {table.shape[1]} numbers: x, y and z are needed")
    return table


def _scan(table: np.ndarray) -> PointScan:
    """Return the scan of a table: x, y, z, then intensity where there are four or seven columns, then colours or normals; a seventh column
    of 255 alone is opacity behind colours."""
    table = table[np.isfinite(table[:, :3]).all(axis=1)]
    opaque = table.shape[1] == 7 and len(table) > 0 and (table[:, 6] == 255).all()
    rest = table[:, 4 if table.shape[1] in (4, 7) and not opaque else 3:][:, :3]
    if rest.shape[1] < 3 or not len(rest):
        return PointScan(table[:, :3])
    if np.abs(np.linalg.norm(rest, axis=1) - 1).max() < UNIT_LENGTH:
        return PointScan(table[:, :3], normals=rest.astype(np.float32))
    if rest.min() >= 0 and (rest.max() <= 1 or (rest.max() <= 255 and (rest == np.rint(rest)).all())):
        return PointScan(table[:, :3], colours=colour_bytes(rest))
    return PointScan(table[:, :3])
