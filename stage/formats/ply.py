"""Point clouds as binary PLY files: float32 x y z, uchar red green blue, and what else is known: normals, intensity, σ, confidence."""

from collections.abc import Mapping
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
BATCH = 1 << 20
"""The number of entries that are written together, which bounds the memory."""


class PointCloud(NamedTuple):
    """The points of a capture or a scan with their colours, and what else is known of them."""

    points: np.ndarray  # [n, 3] float32 metres, camera frame
    colours: np.ndarray  # [n, 3] uint8, display-encoded (sRGB)
    normals: np.ndarray | None = None  # [n, 3] float32, unit, towards the camera; 0 where the neighbours determine none
    intensity: np.ndarray | None = None  # [n] float32, in the unit of the shots of a scan
    sigma: np.ndarray | None = None  # [n] float32 metres
    confidence: np.ndarray | None = None  # [n] float32


def write_ply(cloud: PointCloud, path: str | Path, *, comments: tuple[str, ...] = ()) -> None:
    """Write a point cloud as PLY whole or not at all: position, normal, colour, intensity, σ and confidence, those that are known."""
    scalars = zip(((name,) for name in SCALARS), (cloud.intensity, cloud.sigma, cloud.confidence), strict=True)
    write_vertices(path, {POSITION: cloud.points, NORMAL: cloud.normals, COLOUR: cloud.colours, **dict(scalars)}, comments=comments)


def write_vertices(path: str | Path, columns: Mapping[tuple[str, ...], np.ndarray | None], *, comments: tuple[str, ...],
                   faces: np.ndarray | None = None) -> None:
    """Write vertices, and the faces between them, as a binary PLY file, whole or not at all.
    `columns`: the values of properties, [vertices] or [vertices, properties], stored as uint8 or uint16 if they are, else as float32; None:
    the file has no such properties. `faces`: [faces, 3] numbers of their vertices; None: the file has none.

    Source:
        Turk, "The PLY Polygon File Format", 1994.
    """
    known = {names: values.reshape(len(values), len(names)) for names, values in columns.items() if values is not None}
    kind = np.dtype([(name, values.dtype.newbyteorder("<") if values.dtype.kind == "u" else "<f4")
                     for names, values in known.items() for name in names])
    count = len(next(iter(known.values())))
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {' '.join(text.split())}" for text in comments),
             f"element vertex {count}", *(f"property {TYPES[kind[name]]} {name}" for name in kind.names or ())]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace"))
        for start in range(0, count, BATCH):
            rows = np.empty(min(BATCH, count - start), dtype=kind)
            for names, values in known.items():
                for column, name in enumerate(names):
                    rows[name] = values[start:start + BATCH, column]
            rows.tofile(stream)
        for corners in () if faces is None else np.split(faces, range(BATCH, len(faces), BATCH)):
            entries = np.empty(len(corners), dtype=[("count", "u1"), ("corners", "<i4", 3)])
            entries["count"], entries["corners"] = 3, corners
            entries.tofile(stream)


def read_ply(path: str | Path) -> PointCloud:
    """Read a PLY file that Relit wrote."""
    with storage("read", path), open(path, "rb") as stream:
        start = stream.read(MAX_HEADER)
        end = start.find(b"end_header\n")
        lines = start[:max(end, 0)].decode("ascii", "replace").splitlines()
        counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
        names = tuple(line.split()[-1] for line in lines if line.startswith("property "))
        known = [name for name in (*POSITION, *NORMAL, *COLOUR, *SCALARS) if name in names or name in (*POSITION, *COLOUR)]
        kind = np.dtype([(name, "u1" if name in COLOUR else "<f4") for name in known])
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
