"""Point clouds as binary PLY files: float32 x y z, uchar red green blue, and normals and intensity when they are known."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.errors import ResultError, storage
from stage.files import replacing

POINTS_FILE = "points.ply"
POSITION, NORMAL, COLOUR, INTENSITY = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"), ("intensity",)
TYPES = {np.dtype("<f4"): "float", np.dtype("<u2"): "ushort", np.dtype("u1"): "uchar"}
"""The names of the types that are written."""
MAX_HEADER = 1 << 16
"""The bytes within which the header of a file must end."""


class PointCloud(NamedTuple):
    """The points of a capture or a scan with their colours, and their normals and intensities when they are known."""

    points: np.ndarray  # [n, 3] float32 metres, camera frame
    colours: np.ndarray  # [n, 3] uint8, display-encoded (sRGB)
    normals: np.ndarray | None = None  # [n, 3] float32, unit, towards the camera; 0 where the neighbours determine none
    intensity: np.ndarray | None = None  # [n] float32, in the unit of the shots of a scan


def write_ply(cloud: PointCloud, path: str | Path, *, comments: tuple[str, ...] = ()) -> None:
    """Write a point cloud as PLY whole or not at all: position, normal, colour and intensity, the last three when they are known.

    Source:
        Turk, "The PLY Polygon File Format", 1994.
    """
    kind = _type(cloud.normals is not None, cloud.intensity is not None)
    values = np.empty(len(cloud.points), dtype=kind)
    intensity = None if cloud.intensity is None else cloud.intensity[:, None]
    for names, columns in ((POSITION, cloud.points), (NORMAL, cloud.normals), (COLOUR, cloud.colours), (INTENSITY, intensity)):
        if columns is not None:
            for column, name in enumerate(names):
                values[name] = columns[:, column]
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header(kind, len(values), comments))
        values.tofile(stream)


def header(vertex: np.dtype, count: int, comments: tuple[str, ...], faces: int | None = None) -> bytes:
    """Return the header of a binary PLY file.
    `vertex`: the type of a vertex, whose fields are float32, uint16 or uint8. `faces`: the number of faces, lists of int32 vertex numbers
    behind the vertices; None: the file has none."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {' '.join(text.split())}" for text in comments),
             f"element vertex {count}", *(f"property {TYPES[vertex[name]]} {name}" for name in vertex.names or ())]
    if faces is not None:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace")


def read_ply(path: str | Path) -> PointCloud:
    """Read a PLY file that Relit wrote."""
    with storage("read", path), open(path, "rb") as stream:
        start = stream.read(MAX_HEADER)
        end = start.find(b"end_header\n")
        lines = start[:max(end, 0)].decode("ascii", "replace").splitlines()
        counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
        names = tuple(line.split()[-1] for line in lines if line.startswith("property "))
        with_normals, with_intensity = NORMAL[0] in names, INTENSITY[0] in names
        kind = _type(with_normals, with_intensity)
        if lines[:2] != ["ply", "format binary_little_endian 1.0"] or len(counts) != 1 or names != kind.names:
            raise ResultError(f"{path}: is not a point cloud as relit writes it")
        stream.seek(end + len(b"end_header\n"))
        values = np.fromfile(stream, dtype=kind, count=int(counts[0]))
    if len(values) != int(counts[0]):
        raise ResultError(f"{path}: is truncated: it holds {len(values)} of {counts[0]} points")

    def columns(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([values[name] for name in names], axis=-1)

    return PointCloud(columns(POSITION), columns(COLOUR), columns(NORMAL) if with_normals else None,
                      values[INTENSITY[0]] if with_intensity else None)


def _type(with_normals: bool, with_intensity: bool) -> np.dtype:
    floats = (*POSITION, *(NORMAL if with_normals else ()))
    last = INTENSITY if with_intensity else ()
    return np.dtype([*((name, "<f4") for name in floats), *((name, "u1") for name in COLOUR), *((name, "<f4") for name in last)])
