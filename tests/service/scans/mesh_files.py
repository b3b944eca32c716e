"""Faces of a mesh PLY file as Relit writes it, read without its code."""

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
