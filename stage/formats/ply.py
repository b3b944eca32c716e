"""Point clouds as binary PLY files: float32 x y z, uchar red green blue, and what else is known: normals, intensity, σ, confidence."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.errors import ResultError, storage
from stage.files import replacing

POINTS_FILE = "points.ply"
POSITION, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
SCALARS = ("intensity", "sigma", "confidence")
"""Further properties of a point."""
TYPES = {np.dtype("<f4"): "float", np.dtype("<u2"): "ushort", np.dtype("u1"): "uchar"}
"""The names of the types that are written."""
MAX_HEADER = 1 << 16
"""The bytes within which the header of a file must end."""


class PointCloud(NamedTuple):
    """The points of a capture or a scan with their colours, and what else is known of them."""

    points: np.ndarray  # [n, 3] float32 metres, camera frame
    colours: np.ndarray  # [n, 3] uint8, display-encoded (sRGB)
    normals: np.ndarray | None = None  # [n, 3] float32, unit, towards the camera; 0 where the neighbours determine none
    intensity: np.ndarray | None = None  # [n] float32, in the unit of the shots of a scan
    sigma: np.ndarray | None = None  # [n] float32 metres
    confidence: np.ndarray | None = None  # [n] float32


def write_ply(cloud: PointCloud, path: str | Path, *, comments: tuple[str, ...] = ()) -> None:
    """Write a point cloud as PLY whole or not at all: position, normal, colour, intensity, σ and confidence, those that are known.

    Source:
        Turk, "The PLY Polygon File Format", 1994.
    """
    scalars = [((name,), None if values is None else values[:, None]) for name, values in
               zip(SCALARS, (cloud.intensity, cloud.sigma, cloud.confidence), strict=True)]
    known = [(names, columns) for names, columns in ((POSITION, cloud.points), (NORMAL, cloud.normals), (COLOUR, cloud.colours), *scalars)
             if columns is not None]
    kind = _type(name for names, _ in known for name in names)
    values = np.empty(len(cloud.points), dtype=kind)
    for names, columns in known:
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
        kind = _type(name for name in (*POSITION, *NORMAL, *COLOUR, *SCALARS) if name in names or name in (*POSITION, *COLOUR))
        if lines[:2] != ["ply", "format binary_little_endian 1.0"] or len(counts) != 1 or names != kind.names:
            raise ResultError(f"{path}: is not a point cloud as relit writes it")
        stream.seek(end + len(b"end_header\n"))
        values = np.fromfile(stream, dtype=kind, count=int(counts[0]))
    if len(values) != int(counts[0]):
        raise ResultError(f"{path}: is truncated: it holds {len(values)} of {counts[0]} points")

    def columns(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([values[name] for name in names], axis=-1)

    return PointCloud(columns(POSITION), columns(COLOUR), columns(NORMAL) if NORMAL[0] in names else None,
                      *(values[name] if name in names else None for name in SCALARS))


def _type(names: Iterable[str]) -> np.dtype:
    return np.dtype([(name, "u1" if name in COLOUR else "<f4") for name in names])
