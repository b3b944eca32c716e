"""Faces of a mesh PLY file as Relit writes it, read without its code, and those of a lattice."""

from pathlib import Path

import numpy as np


def read_faces(path: Path) -> np.ndarray:
    raw = path.read_bytes()
    head = raw[:raw.index(b"end_header\n")].decode()
    count = int(head.split("element face ")[1].split()[0])
    kind = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    faces = np.frombuffer(raw[len(raw) - count * kind.itemsize:], dtype=kind)
    assert (faces["count"] == 3).all()
    return faces["corners"]


def lattice_faces(rows: int, cols: int) -> np.ndarray:
    """Two triangles for each square of a lattice of vertices, which are counted along its rows."""
    corner = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
