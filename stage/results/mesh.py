"""A mesh of triangles with what was measured at its vertices, and its PLY file."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.files import replacing
from stage.formats.ply import COLOUR, NORMAL, POSITION, header

BATCH = 1 << 20
"""The number of entries that are written together, which bounds the memory."""


class TriangleMesh(NamedTuple):
    """A mesh of triangles; counter-clockwise seen from outside."""

    points: np.ndarray  # [V, 3] float32 metres, world
    normals: np.ndarray  # [V, 3] float32, unit
    sigma: np.ndarray  # [V] float32 metres, standard deviation along the normal
    seen: np.ndarray  # [V] uint16, how many scans see each vertex
    colours: np.ndarray | None  # [V, 3] uint8, display-encoded (sRGB); None: no scan has colours
    faces: np.ndarray  # [F, 3] int32
    invented: np.ndarray | None = None  # [V] bool, vertices that close a hole and nothing measured; None: there are none


def write_mesh_ply(mesh: TriangleMesh, path: str | Path, *, comments: tuple[str, ...] = ()) -> None:
    """Write a mesh as PLY whole or not at all: position, normal, `sigma`, `seen`, `invented` and colour of the vertices, and the
    faces.

    Source:
        Turk, "The PLY Polygon File Format", 1994.
    """
    coloured = COLOUR if mesh.colours is not None else ()
    kind = np.dtype([*((name, "<f4") for name in (*POSITION, *NORMAL, "sigma")), ("seen", "<u2"),
                     *((name, "u1") for name in (*(("invented",) if mesh.invented is not None else ()), *coloured))])
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header(kind, len(mesh.points), comments, faces=len(mesh.faces)))
        for start in range(0, len(mesh.points), BATCH):
            part = slice(start, start + BATCH)
            values = np.empty(len(mesh.points[part]), dtype=kind)
            for names, columns in ((POSITION, mesh.points), (NORMAL, mesh.normals), (coloured, mesh.colours)):
                for column, name in enumerate(names):
                    assert columns is not None
                    values[name] = columns[part, column]
            values["sigma"], values["seen"] = mesh.sigma[part], mesh.seen[part]
            if mesh.invented is not None:
                values["invented"] = mesh.invented[part]
            values.tofile(stream)
        face = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
        for start in range(0, len(mesh.faces), BATCH):
            corners = mesh.faces[start:start + BATCH]
            entries = np.empty(len(corners), dtype=face)
            entries["count"], entries["corners"] = 3, corners
            entries.tofile(stream)
