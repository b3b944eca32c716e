"""Reading of the vertices of any PLY file: ASCII or binary, with any properties."""

from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from stage.errors import ResultError, storage
from stage.formats.ply import COLOUR, MAX_HEADER, NORMAL, POSITION

TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
         "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
SIGMA, CONFIDENCE, INVENTED = "sigma", "confidence", "invented"
LIST, CORNERS = "list ", ("vertex_indices", "vertex_index")
MOST_POINTS = 2**31
OVERSHOOT = 2.0
"""Floats below this are from 0 to 1, with what rounding or filters add; of 8 bits they would be black."""


class PlyPoints(NamedTuple):
    """The vertices of a PLY file, but those with a coordinate that is not finite, and those that `relit fuse` invented to close a hole."""

    points: np.ndarray  # [n, 3] float64, in the unit of the file
    normals: np.ndarray | None  # [n, 3] float32, as in the file
    colours: np.ndarray | None  # [n, 3] uint8
    sigma: np.ndarray | None  # [n] float64, in the unit of the file
    confidence: np.ndarray | None  # [n] float32
    kept: np.ndarray  # [N] bool, which vertices of the file these are


class _Element(NamedTuple):
    name: str
    entries: int
    properties: list[tuple[str, str]]
    """Name and type of each; the type of a list is LIST and the types of its length and its entries."""


def read_ply_points(path: Path) -> PlyPoints:
    """Read the vertices of a PLY file.

    These are x, y and z of each vertex; nx, ny, nz, red, green, blue, `sigma`, `confidence` and `invented` where there are any. Other
    properties and elements are skipped. Colours are of 8 bits, whatever their type, of 16 bits or more where one is above 255, or floats
    from 0 to 1 where all are below OVERSHOOT.

    Source:
        Turk, "The PLY Polygon File Format", 1994.
    """
    with storage("read", path), open(path, "rb") as stream:
        order, elements, _, start = _header(stream, path)
        stream.seek(start)
        values = _ascii(stream, elements, path) if order == "ascii" else _binary(stream, FORMATS[order], elements, path)
    missing = [name for name in POSITION if name not in values]
    if missing:
        raise ResultError(f"{path}: its vertices have no property {missing[0]}")
    points = np.stack([values[name].astype(np.float64) for name in POSITION], axis=1)
    there = np.asarray(np.isfinite(points).all(axis=1))
    if INVENTED in values:
        there &= values[INVENTED] == 0
    if not there.any():
        raise ResultError(f"{path}: holds no measured vertex with finite coordinates")

    def columns(names: tuple[str, ...]) -> np.ndarray | None:
        return np.stack([values[name][there] for name in names], axis=1) if all(name in values for name in names) else None

    colours = columns(COLOUR)
    if colours is not None and colours.dtype != np.uint8:
        colours = colour_bytes(colours)
    normals, sigma, confidence = columns(NORMAL), columns((SIGMA,)), columns((CONFIDENCE,))
    return PlyPoints(points[there], None if normals is None else normals.astype(np.float32), colours,
                     None if sigma is None else sigma[:, 0].astype(np.float64),
                     None if confidence is None else confidence[:, 0].astype(np.float32), there)


def chosen(ply: PlyPoints, there: np.ndarray) -> PlyPoints:
    """Return the points for which `there` [n] is True."""
    kept = ply.kept.copy()
    kept[kept] = there
    return ply._replace(**{name: values[there] for name, values in ply._asdict().items() if values is not None and name != "kept"},
                        kept=kept)


def returned(points: np.ndarray) -> np.ndarray:
    """Return which of points [n, 3] are measured, [n] bool: several at exactly 0 0 0 are how devices write that nothing came back."""
    there = np.asarray(points.any(axis=1))
    return there if np.count_nonzero(~there) > 1 else np.ones(len(points), dtype=bool)


def vertices_of(path: Path) -> int:
    """Return the number of vertices that the header of a PLY file names."""
    with storage("read", path), open(path, "rb") as stream:
        return _header(stream, path)[1][-1].entries


def colour_bytes(colours: np.ndarray) -> np.ndarray:
    """Return colours [n, 3] of any type and scale as uint8."""
    return np.rint(np.clip(np.nan_to_num(colours) * (255 / _full_scale(colours)), 0, 255)).astype(np.uint8)


def _full_scale(colours: np.ndarray) -> float:
    """Return the number that is full brightness, by the type and the largest of colours [n, 3]."""
    most = float(colours[np.isfinite(colours)].max(initial=0))
    whole = colours.dtype.kind != "f"
    if not whole and most < OVERSHOOT:
        return 1.0
    largest = float(np.iinfo(colours.dtype).max) if whole else 65535.0
    return 255.0 if most <= 255 else min(65535.0, largest) if most <= 65535 else largest


def read_ply_faces(path: Path, kept: np.ndarray) -> np.ndarray | None:
    """Return the faces of a PLY file whose vertices they follow, [F, 3] int64 numbers of the `kept` [N] vertices, or None if it has none;
    faces with a vertex that was not kept are left out. Raises ResultError: it has faces that are no triangles, or of vertices that are not
    there."""
    with storage("read", path), open(path, "rb") as stream:
        order, elements, further, start = _header(stream, path)
        if not further or not further[0].entries:
            return None
        face = further[0]
        lists = [(name, kind) for name, kind in face.properties if kind.startswith(LIST)]
        if face.name != "face" or len(face.properties) != 1 or len(lists) != 1 or lists[0][0] not in CORNERS:
            raise ResultError(f"{path}: {face.name}, its element behind the vertices, is no plain list of the vertices of faces")
        stream.seek(start)
        if order == "ascii":
            for _ in range(sum(element.entries for element in elements)):
                stream.readline()
            table = np.array([line.split()[:4] for line in stream.read().splitlines()[:face.entries]], dtype=object)
            corners = table.astype(np.int64) if table.ndim == 2 else np.zeros((0, 4), dtype=np.int64)
        else:
            for element in elements:
                stream.seek(element.entries * sum(np.dtype(TYPES[kind]).itemsize for _, kind in element.properties), 1)
            count, index = (FORMATS[order] + TYPES[kind] for kind in lists[0][1].split()[1:])
            values = np.fromfile(stream, dtype=[("count", count), ("at", index, 3)], count=face.entries)
            corners = np.column_stack([values["count"], values["at"]]).astype(np.int64)
    if len(corners) != face.entries or (corners[:, 0] != 3).any():
        raise ResultError(f"{path}: its {face.entries} faces are no triangles, or it is truncated")
    corners = corners[:, 1:]
    if corners.min() < 0 or corners.max() >= len(kept):
        raise ResultError(f"{path}: has a face of a vertex that is not there")
    return (np.cumsum(kept) - 1)[corners[kept[corners].all(axis=1)]]


def _header(stream: BinaryIO, path: Path) -> tuple[str, list[_Element], list[_Element], int]:
    """Return the format, the elements up to the vertices, those behind them, and the position behind the header."""
    raw = stream.read(MAX_HEADER)
    end = raw.find(b"end_header")
    behind = raw.find(b"\n", end) + 1
    lines = [line.split() for line in raw[:max(end, 0)].decode("ascii", "replace").splitlines()]
    if end < 0 or behind == 0 or not lines or lines[0] != ["ply"]:
        raise ResultError(f"{path}: is not a PLY file, or its header does not end within {MAX_HEADER} bytes")
    order, elements = "", []
    for words in lines[1:]:
        match words:
            case ["format", name, *_]:
                order = name
            case ["element", name, count] if count.isdecimal() and int(count) <= MOST_POINTS:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count, kind, name] if elements and count in TYPES and kind in TYPES:
                elements[-1].properties.append((name, f"{LIST}{count} {kind}"))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name, kind))
            case [("comment" | "obj_info"), *_] | []:
                pass
            case _:
                raise ResultError(f"{path}: its header has a line that is not understood: {' '.join(words)[:60]}")
    if order not in FORMATS:
        raise ResultError(f"{path}: its format is {order[:40] or 'not given'}: must be one of {', '.join(FORMATS)}")
    place = next((index for index, element in enumerate(elements) if element.name == "vertex"), None)
    if place is None or elements[place].entries == 0:
        raise ResultError(f"{path}: has no vertices")
    names = [name for name, _ in elements[place].properties]
    if twice := next((name for name in (*POSITION, *NORMAL, *COLOUR, SIGMA, CONFIDENCE, INVENTED) if names.count(name) > 1), None):
        raise ResultError(f"{path}: its vertices have the property {twice} twice, and nothing tells which is meant: name one otherwise")
    if any(kind.startswith(LIST) for element in elements[:place + 1] for _, kind in element.properties):
        raise ResultError(f"{path}: has lists before the end of its vertices: write the vertices first, without lists")
    return order, elements[:place + 1], elements[place + 1:], behind


def _binary(stream: BinaryIO, order: str, elements: list[_Element], path: Path) -> dict[str, np.ndarray]:
    for element in elements:
        kind = np.dtype([(f"{number} {name}", order + TYPES[kind]) for number, (name, kind) in enumerate(element.properties)])
        values = np.fromfile(stream, dtype=kind, count=element.entries)
        if len(values) != element.entries:
            raise ResultError(f"{path}: is truncated: it holds {len(values)} of {element.entries} entries of {element.name}")
    names = [name for name, _ in elements[-1].properties]
    return {name: values[f"{number} {name}"] for number, name in enumerate(names)}


def _ascii(stream: BinaryIO, elements: list[_Element], path: Path) -> dict[str, np.ndarray]:
    for element in elements[:-1]:
        for _ in range(element.entries):
            stream.readline()
    vertex = elements[-1]
    try:
        table = np.loadtxt(stream, dtype=np.float64, max_rows=vertex.entries, ndmin=2, comments=None, encoding="ascii")
    except (ValueError, UnicodeDecodeError) as error:
        raise ResultError(f"{path}: its vertices are not rows of {len(vertex.properties)} numbers each") from error
    if table.shape != (vertex.entries, len(vertex.properties)):
        raise ResultError(f"{path}: is truncated or malformed: it holds {table.shape[0]} of {vertex.entries} vertices, with "
                          f"{table.shape[1]} of {len(vertex.properties)} properties")
    return {name: table[:, number].astype(TYPES[kind]) for number, (name, kind) in enumerate(vertex.properties)}
