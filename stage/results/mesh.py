"""A mesh of triangles with what was measured at its vertices, and its PLY file."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.formats.ply import COLOUR, NORMAL, POSITION, write_vertices


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
    faces."""
    invented = None if mesh.invented is None else mesh.invented.astype(np.uint8)
    write_vertices(path, {POSITION: mesh.points, NORMAL: mesh.normals, ("sigma",): mesh.sigma, ("seen",): mesh.seen,
                          ("invented",): invented, COLOUR: mesh.colours}, comments=comments, faces=mesh.faces)
