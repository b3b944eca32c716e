"""The depth and the photometric normals of many views joined on a fused mesh, on the statue with sharp edges: the table of docs/joining.md.

    python -m benchmarks.joining_views [--write docs/joining.md]

Eight range images of 120 x 160 pixels of 7.5 mm with 1 mm of noise; normals have noise of 0.5° and, in each view about another axis, a
drift. All vertices count.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.file_mutations import write_between
from service.requests.fuse import FuseRequest
from service.scans.fuse import fuse
from stage.camera import Camera
from stage.maps import SurfaceMaps
from stage.scans.ply_points import read_ply_points
from stage.scans.rigid import exponential
from tests.scenes.statue import Shot, distance, nearest_part, turntable, write_scans

START, END = "<!-- made by benchmarks.joining_views -->", "<!-- end of the views -->"
DEPTH_SIGMA, NORMAL_DEGREES, VOXEL = 1e-3, 0.5, 4e-3
DRIFTS = (0.0, 2.0)
PARTS = ("head", "body", "foot", "blade", "left plate")


def maps_of(shot: Shot, seed: int, drift_degrees: float) -> SurfaceMaps:
    """Return normals with noise that are turned by the drift about an axis of their own."""
    rng, step = np.random.default_rng(seed), 1e-5
    camera = Camera(projection="perspective", resolution=shot.side[::-1], focal_px=(shot.focal, shot.focal))
    points = camera.points(-shot.true)[shot.mask] @ shot.world_from_camera[:3, :3].T + shot.world_from_camera[:3, 3]
    slope = np.stack([distance(points + step * axis) - distance(points - step * axis) for axis in np.eye(3)], axis=-1)
    own = slope / np.linalg.norm(slope, axis=-1, keepdims=True) @ shot.world_from_camera[:3, :3]
    axis = rng.standard_normal(3)
    own = own @ exponential(np.radians(drift_degrees) * axis / np.linalg.norm(axis)).T
    own += np.radians(NORMAL_DEGREES) * rng.standard_normal(own.shape)
    normal = np.zeros((*shot.side, 3), dtype=np.float32)
    normal[shot.mask] = own / np.linalg.norm(own, axis=1, keepdims=True)
    return SurfaceMaps(camera=camera, mask=shot.mask, normal=normal, sigma=np.full(shot.side, NORMAL_DEGREES, dtype=np.float32))


def main() -> None:
    """Print the table, or write it into the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="the document that the table goes into")
    arguments = parser.parse_args()
    shots = turntable(8, (160, 120), sigma=DEPTH_SIGMA)
    lines = [f"| drift of the normals | surface | median, mm | RMS, mm | 99 %, mm | {', '.join(PARTS)}: RMS, mm | contradicted vertices |",
             "|---|---|---|---|---|---|---|"]
    for drift in DRIFTS:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            file = write_scans(folder, shots, sigma=DEPTH_SIGMA, maps=[maps_of(shot, number, drift) for number, shot in enumerate(shots)])
            for joins in (False, True) if drift == DRIFTS[0] else (True,):
                result = fuse(FuseRequest(scan_set=file, out=folder / str(joins), voxel_m=VOXEL, texture=False, join_normals=joins,
                                          device="cpu"))
                assert result.mesh_path is not None
                points = read_ply_points(result.mesh_path).points
                error, part = 1e3 * distance(points), nearest_part(points)
                parts = ", ".join(f"{np.sqrt(np.mean(error[part == each] ** 2)):.2f}" for each in PARTS)
                stayed = result.facts["joined_normals"]["contradicted_vertices"] if joins else ""
                said = f"| {drift:g}° | joined" if joins else "| | depth alone"
                lines.append(f"{said} | {np.median(np.abs(error)):.3f} | {np.sqrt(np.mean(error**2)):.3f} | "
                             f"{np.percentile(np.abs(error), 99):.2f} | {parts} | {stayed} |")
    if arguments.write is None:
        print("\n".join(lines))
    else:
        write_between(arguments.write, START, END, "\n".join(lines))


if __name__ == "__main__":
    main()
