"""Scans of a simulated figure as taken, registered and fused, and the error of the surface, as one picture, docs/scans.png.

    python -m benchmarks.scan_pictures [--open3d PYTHON]

No pose is known to the registration. The surface is laid on the true one by the true pose of the first scan alone.
PYTHON is an interpreter that has open3d, which then fuses the same scans with the same poses: benchmarks/fusion_open3d.py.
"""

import argparse
import colorsys
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio

from benchmarks.many_views import off_surface, write_scans
from service.relight.sheet import BACKGROUND, INK, write_sheet
from service.requests.register import FuseRequest, RegisterRequest
from service.scans.fusion.fuse import fuse
from service.scans.points.ply_points import read_ply_points
from service.scans.points.rigid import applied, inverse
from service.scans.register import register_scans
from stage.formats.images import pixels_of
from stage.sets.scan_set import read_scan_set
from tests.scenes.turntable import DISTANCE_M, MM, View, figure, turntable
from tests.service.scans.mesh_files import read_faces

TARGET = Path(__file__).parents[1] / "docs" / "scans.png"
HEIGHT, WIDTH, FINER = 400, 300, 2
"""Pixels of a picture, and how many times finer it is drawn."""
EXTENT_M = 1.1
"""Height that a picture shows."""
SCALE_MM = 0.4
"""Error that has the full colour."""
INSIDE, EXACT, OUTSIDE = np.array([[0.10, 0.35, 0.85], [0.90, 0.90, 0.90], [0.90, 0.45, 0.05]])
"""Colours of a surface that lies too deep, right, and too far out."""
BORDER = np.array([1.0, 0.08, 0.08])
SLICE_M = 0.006
"""Half the thickness of the slices."""


class Mesh(NamedTuple):
    """A surface in the frame of the truth."""

    points: np.ndarray  # [V, 3] metres
    faces: np.ndarray  # [F, 3]


class Look(NamedTuple):
    """An orthographic view, from an angle about +y and an elevation."""

    angle_deg: float
    elevation_deg: float

    def axes(self) -> np.ndarray:
        """Return right, up and towards the viewer as rows, [3, 3]."""
        turn, rise = np.radians([self.angle_deg, self.elevation_deg])
        back = np.array([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)])
        right = np.array([np.cos(turn), 0, -np.sin(turn)])
        return np.stack([right, np.cross(back, right), back])


FRONT, BELOW, ABOVE = Look(25, 12), Look(25, -40), Look(0, 90)


def drawn(look: Look, points: np.ndarray, colours: np.ndarray, *, dot: int, extent: float = EXTENT_M) -> np.ndarray:
    """Return the picture of points, [HEIGHT, WIDTH, 3]: in a pixel the nearest shows; `dot` is the side of one in fine pixels."""
    rows, cols = HEIGHT * FINER, WIDTH * FINER
    right, up, near = look.axes() @ points.T
    col, row = np.floor(right * rows / extent + cols / 2).astype(int), np.floor(rows / 2 - up * rows / extent).astype(int)
    order = np.argsort(near)  # the nearest is written last
    canvas = np.empty((rows, cols, 3))
    canvas[:] = BACKGROUND
    best = np.full((rows, cols), -np.inf)
    for down in range(dot):
        for across in range(dot):
            r, c = row[order] + down, col[order] + across
            seen = (r >= 0) & (r < rows) & (c >= 0) & (c < cols)
            r, c, which = r[seen], c[seen], order[seen]
            layer, shown = np.full((rows, cols), -np.inf), np.zeros((rows, cols), dtype=int)
            layer[r, c], shown[r, c] = near[which], which
            nearer = layer > best
            best[nearer], canvas[nearer] = layer[nearer], colours[shown[nearer]]
    return np.asarray(canvas.reshape(HEIGHT, FINER, WIDTH, FINER, 3).mean(axis=(1, 3)), dtype=np.float32)


def sampled(mesh: Mesh, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the faces, closer than a fine pixel, and the values of the vertices there."""
    corners = mesh.points[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    steps = max(int(np.ceil(longest / (EXTENT_M / HEIGHT / FINER))), 1)
    points, held = [], []
    for first in range(steps + 1):
        for second in range(steps + 1 - first):
            weights = np.array([first, second, steps - first - second]) / steps
            points.append(np.einsum("k,fkc->fc", weights, corners))
            held.append(np.einsum("k,fkc->fc", weights, values[mesh.faces]))
    return np.concatenate(points), np.concatenate(held)


def shading(mesh: Mesh, look: Look) -> np.ndarray:
    """Return the brightness of the vertices [V, 1] under a light beside the viewer; surfaces seen from behind are dark."""
    a, b, c = (mesh.points[mesh.faces[:, corner]] for corner in range(3))
    normal = np.zeros_like(mesh.points)
    for corner in range(3):
        np.add.at(normal, mesh.faces[:, corner], np.cross(b - a, c - a))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    light = np.array([-0.45, 0.5, 0.75]) @ look.axes()
    return np.asarray(0.25 + 0.75 * np.clip(normal @ light / np.linalg.norm(light), 0, 1))[:, None]


def borders(mesh: Mesh) -> np.ndarray:
    """Return points along the edges that have a face on one side alone."""
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    found, counts = np.unique(edges, axis=0, return_counts=True)
    a, b = (mesh.points[found[counts == 1, end]] for end in range(2))
    return np.concatenate([a + (b - a) * along for along in np.linspace(0, 1, 6)])


def with_borders(mesh: Mesh, look: Look) -> np.ndarray:
    """Return the shaded surface with its open borders in red."""
    points, colours = sampled(mesh, shading(mesh, look) * np.array([0.85, 0.84, 0.80]))
    line = borders(mesh) + 2 * EXTENT_M / HEIGHT * look.axes()[2]  # before the surface that it ends
    line = np.concatenate([line + offset * EXTENT_M / HEIGHT / FINER * look.axes()[axis] for axis in range(2) for offset in (-1, 0, 1)])
    return drawn(look, np.concatenate([points, line]), np.concatenate([colours, np.broadcast_to(BORDER, line.shape)]), dot=2)


def error_colours(error_mm: np.ndarray) -> np.ndarray:
    """Return the colours [..., 3] of signed errors."""
    at = np.clip(error_mm / SCALE_MM, -1, 1)
    return np.stack([np.interp(at, (-1, 0, 1), channel) for channel in zip(INSIDE, EXACT, OUTSIDE, strict=True)], axis=-1)


def with_errors(mesh: Mesh, look: Look) -> np.ndarray:
    """Return the surface in the colours of its error, faintly shaded."""
    error = off_surface(mesh.points) / MM
    points, colours = sampled(mesh, error_colours(error) * (0.4 + 0.6 * shading(mesh, look)))
    return drawn(look, points, colours, dot=2)


def scale_bar() -> np.ndarray:
    """Return the scale of the errors, [HEIGHT, 110, 3]."""
    bar = np.empty((HEIGHT, 110, 3), dtype=np.float32)
    bar[:] = BACKGROUND
    top, bottom = 40, HEIGHT - 40
    bar[top:bottom, 6:28] = error_colours(np.linspace(SCALE_MM, -SCALE_MM, bottom - top))[:, None]
    image = oiio.ImageBuf(bar)
    for value in np.linspace(SCALE_MM, -SCALE_MM, 5):
        y = round(np.interp(value, (-SCALE_MM, SCALE_MM), (bottom, top)))
        oiio.ImageBufAlgo.render_text(image, 34, y + 5, f"{value:+.2f} mm" if value else "0", 14, "", INK)
    return pixels_of(image)


def of_scans(scans: list[np.ndarray], look: Look, *, only: float | None = None) -> np.ndarray:
    """Return the picture of scans, each in its colour; `only`: of a slice at this height."""
    colours = [colorsys.hsv_to_rgb(number / len(scans), 0.75, 1.0) for number in range(len(scans))]
    points, shown = np.concatenate(scans), np.repeat(colours, [len(scan) for scan in scans], axis=0)
    if only is not None:
        inside = np.abs(points[:, 1] - only) < SLICE_M
        return drawn(look, points[inside], shown[inside], dot=3, extent=0.75)
    shuffled = np.random.default_rng(0).normal(scale=2e-3, size=len(points))  # so that no scan hides the others where they agree
    return drawn(look, points + shuffled[:, None] * look.axes()[2], shown, dot=3)


def by_open3d(python: str, views: list[View], poses: list[np.ndarray], voxel_m: float, folder: Path) -> Mesh:
    """Fuse the same scans with Open3D in another interpreter."""
    np.savez(folder / "shots.npz", depth=np.stack([view.depth for view in views]), pose=np.stack(poses),
             focal=np.array([view.camera.focal_px[0] for view in views]))
    subprocess.run([python, Path(__file__).with_name("fusion_open3d.py"), folder / "shots.npz", folder / "mesh.npz", str(voxel_m)],
                   capture_output=True, check=True)
    made = np.load(folder / "mesh.npz")
    return Mesh(made["points"].astype(np.float64), made["faces"])


def error_picture(name: str, mesh: Mesh) -> tuple[str, np.ndarray]:
    """Return the picture of the errors of a surface with its title, and print what they are."""
    error = np.abs(off_surface(mesh.points)) / MM
    print(f"{name}: {len(mesh.points)} vertices, error: median {np.median(error):.3f} mm, 99 % {np.percentile(error, 99):.3f} mm, largest "
          f"{error.max():.2f} mm")
    return f"{name}, error: median {np.median(error):.3f} mm", with_errors(mesh, FRONT)


def main() -> None:
    """Register and fuse the scans, print what was measured, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--views", type=int, default=18)
    parser.add_argument("--rows", type=int, default=320)
    parser.add_argument("--voxel-mm", type=float, default=2.0)
    parser.add_argument("--open3d", help="a Python interpreter with open3d")
    parser.add_argument("--out", type=Path, default=TARGET)
    given = parser.parse_args()
    views = turntable(figure, [360 / given.views * k for k in range(given.views)], rows=given.rows)
    true = views[0].world_from_scan
    with tempfile.TemporaryDirectory() as work:
        file = write_scans(Path(work) / "in", views, [None] * len(views))
        found = register_scans(RegisterRequest(scan_set=file, out=Path(work) / "registered", reference="0"))
        listed = read_scan_set(found.scan_set_path)[1].scans
        relative = [np.array(scan.scan_to_world) for scan in listed]
        motion = true @ inverse(relative[0])
        fused = fuse(FuseRequest(scan_set=found.scan_set_path, out=Path(work) / "fused", voxel_m=MM * given.voxel_mm, texture=False,
                                 device="cpu"))
        assert fused.mesh_path is not None
        mesh = Mesh(applied(motion, read_ply_points(fused.mesh_path).points), read_faces(fused.mesh_path))
        poses = [motion @ pose for pose in relative]
        other = None if given.open3d is None else by_open3d(given.open3d, views, poses, MM * given.voxel_mm, Path(work))
    own = [view.camera.points(-view.depth)[view.mask].astype(np.float64) for view in views]
    together = [applied(pose, points) for pose, points in zip(poses, own, strict=True)]
    taken = [applied(true, points) for points in own]  # as if all had been taken from the place of the first
    holes = fused.facts["holes"]
    print(f"{given.views} scans of {given.rows * 3 // 4} x {given.rows} pixels of {DISTANCE_M / MM / views[0].camera.focal_px[0]:.2f} mm, "
          f"{found.joined} joined; voxels of {given.voxel_mm:g} mm; {holes['count']} borders of {holes['open_length_m']} m, "
          f"{holes['closed_share']:.1%} of the surface closed")
    for warning in (*found.warnings, *fused.warnings):
        print(warning)
    errors = [error_picture("relit fuse", mesh), *(() if other is None else (error_picture("Open3D", other),))]
    write_sheet(given.out, [
        [("as taken: each scan in its own frame", of_scans(taken, FRONT)), ("registered", of_scans(together, FRONT)),
         ("as taken, slice from above", of_scans(taken, ABOVE, only=0.0)),
         ("registered, slice from above", of_scans(together, ABOVE, only=0.0))],
        [("fused; open borders in red", with_borders(mesh, FRONT)), ("from below", with_borders(mesh, BELOW)), *errors, ("", scale_bar())],
    ], height=HEIGHT)


if __name__ == "__main__":
    main()
