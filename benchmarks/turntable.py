"""A light-stage turntable end to end: the commands, the surface and its normals against the truth, and pictures of unseen views by Blender.

    python samples/make_turntable.py --out DIR
    python -m benchmarks.turntable DIR [--write docs/scans.md] [--picture docs/turntable.png]

The three commands run as processes of their own. Blender opens the asset as it is imported; it must be installed (`make clients`).
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.accuracy import angles_deg
from benchmarks.clients.comparison import compare
from benchmarks.clients.render import Client, Programs, Sun
from benchmarks.file_mutations import write_between
from kernels.surface.nearest import NearestOnMesh
from service.relight.sheet import write_sheet
from service.scans.fusion.fuse import ASSET_FILE, MESH_FILE
from service.scans.points.ply_points import read_ply_faces, read_ply_points
from stage.capture.camera import Camera
from stage.formats import exr

START, END = "<!-- made by benchmarks.turntable -->", "<!-- end of the turntable -->"
ROOT = Path(__file__).resolve().parents[1]
MM = 1e3
SAMPLES = 256
"""Paths of each pixel in Blender."""
REACH_M = 0.002
"""Distance beyond which there is no fused surface at a place, metres."""
AROUND = 5
"""Nearest pixels of all views, some half of a pixel away, between which the true normals are compared."""
EVEN_DEGREES = 6.0
"""Difference between them up to which a pixel shows one normal."""
COMMANDS = (("solve", "views", "--no-temporal", "--out", "solved"), ("depth", "views", "--no-temporal", "--out", "depth"),
            ("fuse", "scan-set.json", "--join-normals", "--close", "all", "--out", "fused"))


class Errors(NamedTuple):
    """The errors of a fused surface."""

    vertices: int
    out: np.ndarray  # [V] metres, of the vertices from the true surface
    back: np.ndarray  # [P] metres, of what the pixels of all views show from the fused surface
    angle: np.ndarray  # [Q] degrees, of the normals of the fused surface where it is within REACH_M of what the pixels show
    turn: np.ndarray  # [Q] degrees, by which the true normals of these pixels differ from those of the nearest others, in the mean


def run(folder: Path) -> list[tuple[str, float, float]]:
    """Run the three commands, and return the text, the seconds and the seconds of processors of each."""
    rows = []
    for words in COMMANDS:
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        program = [sys.executable, "-m", "service.cli.main"]
        subprocess.run(program + list(words), cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        rows.append((f"relit {' '.join(words)}", time.perf_counter() - began,
                     after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime))
    return rows


def surface_errors(folder: Path) -> Errors:
    """Measure the fused surface. Distances are those from the nearest point of the other mesh, and a normal there is blended from those of
    the corners of its face, as programs shade."""
    ply, truth = folder / "fused" / MESH_FILE, np.load(folder / "truth.npz")
    vertices = read_ply_points(ply)
    faces = read_ply_faces(ply, vertices.kept)
    assert vertices.normals is not None and faces is not None
    found, true = Shaded(vertices.points, faces, vertices.normals), Shaded(truth["points"], truth["faces"], truth["normals"])
    seen, given = truth["seen_points"], truth["seen_normals"]
    back, normals = found.nearest(seen)
    there = back < REACH_M
    around = cKDTree(seen).query(seen, k=AROUND + 1)[1].T[1:]
    turn = np.mean([angles_deg(given, given[other]) for other in around], axis=0)
    return Errors(len(vertices.points), true.nearest(vertices.points)[0], back, angles_deg(normals, given)[there], turn[there])


class Shaded(NamedTuple):
    """A mesh with a normal of each vertex."""

    points: np.ndarray  # [V, 3] metres
    faces: np.ndarray  # [F, 3]
    normals: np.ndarray  # [V, 3]

    def nearest(self, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance of each of [n, 3] points, metres, and the normal at the nearest point of the mesh, [n, 3]."""
        found = NearestOnMesh(self.points, self.faces, device="cpu").search(to, within=1.0)
        corners = self.faces[found.face]
        at, normals = (np.einsum("nk,nkx->nx", found.share, values[corners]) for values in (self.points, self.normals))
        return np.linalg.norm(to - at, axis=1), normals / np.linalg.norm(normals, axis=1, keepdims=True)


class Shown(NamedTuple):
    """An unseen view."""

    truth: np.ndarray  # [rows, cols, 3] linear, path traced
    picture: np.ndarray  # [rows, cols, 3] linear, the asset in Blender
    error: float  # RMSE over the mean of the truth


def unseen_views(folder: Path) -> list[Shown]:
    """Return each unseen view as path traced and as Blender shows the asset."""
    unseen = json.loads((folder / "unseen.json").read_text())
    views = []
    with Programs() as programs:
        for view in unseen["views"]:
            truth = np.stack([exr.read(folder / view["image"])[0][channel] for channel in "RGB"], axis=-1).astype(np.float32)
            camera = Camera.model_validate(unseen["camera"] | {"world_from_camera": view["world_from_camera"]})
            shown = programs.render(Client.BLENDER, folder / "fused" / ASSET_FILE, camera,
                                    Sun(tuple(view["direction"]), tuple(view["irradiance"])), samples=SAMPLES)
            error = compare(shown, truth, (truth.max(axis=-1) > 0) | (shown[..., 3] > 0), scaled=False).rmse
            views.append(Shown(truth, np.ascontiguousarray(shown[..., :3]), error))
    return views


def normal_rows(found: Errors) -> list[str]:
    """Return what the table says of normals."""
    even = found.turn < EVEN_DEGREES
    return [f"| normals: mean; median; 99 % | {_spread(found.angle)}° |",
            f"| normals where those of the truth turn by less than {EVEN_DEGREES:g}° between neighbours, {even.mean():.0%} of the pixels | "
            f"{_spread(found.angle[even])}° |"]


def _spread(values: np.ndarray) -> str:
    return f"{values.mean():.3f}; {np.median(values):.3f}; {np.percentile(values, 99):.3f}"


def main() -> None:
    """Run, measure, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="folder that samples/make_turntable.py has written")
    parser.add_argument("--write", type=Path, help="page to put the table into")
    parser.add_argument("--picture", type=Path, help="PNG to write")
    args = parser.parse_args()
    commands = run(args.folder)
    found = surface_errors(args.folder)
    views = unseen_views(args.folder)
    table = ["| command | seconds | of processors |", "|---|---|---|",
             *(f"| `{text}` | {taken:.0f} | {busy:.0f} |" for text, taken, busy in commands), "",
             "| | |", "|---|---|",
             f"| vertices | {found.vertices} |",
             f"| surface from the truth: mean; median; 99 % | {_spread(MM * found.out)} mm |",
             f"| truth in sight from the surface: mean; median; 99 % | {_spread(MM * found.back)} mm |",
             f"| Chamfer distance, mean of both | {MM * (found.out.mean() + found.back.mean()) / 2:.3f} mm |",
             *normal_rows(found),
             f"| unseen views in Blender, RMSE over the mean | {'; '.join(f'{view.error:.3f}' for view in views)} |"]
    text = "\n".join(table)
    print(text)
    if args.write:
        write_between(args.write, START, END, text)
    if args.picture:
        write_sheet(args.picture, [[pair for view in views for pair in
                                    (("path traced", view.truth), (f"Blender: {view.error:.3f}", view.picture))]], height=300)


if __name__ == "__main__":
    main()
