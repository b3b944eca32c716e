"""A machined part, its scans with known faults, and the files of both.

A plate of 80 x 50 x 8 mm with a boss beside its middle, a rib and a hollow, so that no turn of it looks like another.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

SIGMA_M = 2e-5
"""Standard deviation of the points of a scan along the normal."""


class Part(NamedTuple):
    points: np.ndarray  # [V, 3] mm
    faces: np.ndarray  # [F, 3]

    def normals(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.points[self.faces], 1, 0)
        return np.cross(b - a, c - a)


def _height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    boss = 8 + 14 * np.clip((12 - np.hypot(x - 15, y - 5)) / 3, 0, 1)
    rib = 6 * np.exp(-((y + 12) / 4) ** 2) * np.clip((30 - np.abs(x + 5)) / 4, 0, 1)
    return boss + rib - 4 * np.clip(1 - np.hypot(x + 25, y - 10) / 6, 0, 1)


def machined_part(cols: int = 81, rows: int = 51) -> Part:
    """Return the part as a closed mesh."""
    x, y = np.meshgrid(np.linspace(-40, 40, cols), np.linspace(-25, 25, rows), indexing="ij")
    top = np.stack([x, y, _height(x, y)], axis=-1).reshape(-1, 3)
    count = len(top)
    index = np.arange(count).reshape(cols, rows)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    below = count + np.stack([[a, c, b], [a, d, c]])
    faces = [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1), *(np.stack(list(each), axis=1) for each in below)]
    for line in (index[:, 0], index[-1, :], index[::-1, -1], index[0, ::-1]):
        i, j = line[:-1], line[1:]
        faces += [np.stack([count + i, count + j, j], axis=1), np.stack([count + i, j, i], axis=1)]
    return Part(np.concatenate([top, top * [1, 1, 0]]), np.concatenate(faces))


def cylinder(sides: int = 64, radius: float = 15.0, length: float = 40.0) -> Part:
    """Return a closed cylinder along z."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([np.column_stack([ring, np.full(sides, z)]) for z in (0.0, length)] + [[[0, 0, 0], [0, 0, length]]])
    i = np.arange(sides)
    j = (i + 1) % sides
    low, high = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = [(i, j, sides + j), (i, sides + j, sides + i), (j, i, low), (sides + i, sides + j, high)]
    return Part(points, np.concatenate([np.stack(each, axis=1) for each in faces]))


def any_pose(random: np.random.Generator) -> np.ndarray:
    """Return scan_from_design [4, 4], metres: any turn, some tenths of a metre away."""
    q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = q * np.linalg.det(q), random.normal(0, 0.3, 3)
    return pose


class Scanned(NamedTuple):
    points: np.ndarray  # [n, 3] metres
    normals: np.ndarray  # [n, 3]


def scan_of(part: Part, random: np.random.Generator, count: int = 20_000, pose: np.ndarray | None = None, hidden=None, fault=None
            ) -> Scanned:
    """Return points that lie evenly on a part, with noise along its normals.

    Args:
        hidden: tells by points [n, 3] in mm and normals [n, 3] which are not seen.
        fault: the deviation in mm of each.
    """
    normals = part.normals()
    area = np.linalg.norm(normals, axis=1)
    face = random.choice(len(area), count, p=area / area.sum())
    root, other = np.sqrt(random.random(count)), random.random(count)
    share = np.stack([1 - root, root * (1 - other), root * other], axis=1)
    points, normal = np.einsum("nk,nki->ni", share, part.points[part.faces[face]]), (normals / area[:, None])[face]
    seen = np.ones(count, bool) if hidden is None else ~hidden(points, normal)
    off = random.normal(0, 1e3 * SIGMA_M, count) + (0 if fault is None else fault(points, normal))
    pose = np.eye(4) if pose is None else pose
    placed = 1e-3 * (points + normal * off[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    return Scanned(placed[seen], (normal @ pose[:3, :3].T)[seen])


def write_scan(path: Path, scan: Scanned, sigma_m: float | None = SIGMA_M) -> Path:
    names = ("x", "y", "z", "nx", "ny", "nz", *(("sigma",) if sigma_m else ()))
    values = np.zeros(len(scan.points), [(name, "<f4") for name in names])
    for name, column in zip(names, [*scan.points.T, *scan.normals.T, *([np.full(len(values), sigma_m)] if sigma_m else [])], strict=True):
        values[name] = column
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(values)}", *(f"property float {name}" for name in names)]
    path.write_bytes("\n".join([*head, "end_header\n"]).encode() + values.tobytes())
    return path


def write_stl(path: Path, part: Part) -> Path:
    facets = np.zeros(len(part.faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets["corners"] = part.points[part.faces]
    path.write_bytes(bytes(80) + np.uint32(len(facets)).tobytes() + facets.tobytes())
    return path


def write_mesh(path: Path, part: Part) -> Path:
    """Write a mesh as PLY, without normals and σ."""
    faces = np.zeros(len(part.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, part.faces
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(part.points)}", *(f"property float {name}" for name in "xyz"),
            f"element face {len(faces)}", "property list uchar int vertex_indices"]
    path.write_bytes("\n".join([*head, "end_header\n"]).encode() + part.points.astype("<f4").tobytes() + faces.tobytes())
    return path
