"""relit fuse --join-normals: a waved ball seen all around, whose depth has noise and whose photometric normals drift."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from service.errors import RequestError
from service.scans.fusion.fuse import FuseResult
from service.scans.points.ply_points import read_ply_points
from tests.scenes.in_front import gradient, photometric, unit
from tests.scenes.register import fuse_scans
from tests.scenes.statue import Shot, turntable, write_scans
from tests.service.scans.mesh_files import read_faces

RADIUS, WAVE, DEEP = 0.35, 60.0, 0.004
"""Metres, waves per metre as radians, and metres."""
DEPTH_SIGMA, NORMAL_SIGMA = 1.5e-3, np.radians(0.5)
VOXEL = 5e-3


def ball(points: np.ndarray) -> np.ndarray:
    """The signed distance, to a tenth of a percent near the surface; a little less than it elsewhere."""
    return 0.85 * field(points)


def field(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points, axis=-1) - RADIUS - DEEP * np.sin(WAVE * points[..., 1]) * np.cos(WAVE * points[..., 0] / 2 + 1)


@cache
def shots() -> list[Shot]:
    return turntable(8, (160, 120), sigma=DEPTH_SIGMA, scene=ball)


class Errors(NamedTuple):
    """RMS over what lies away from the rims above and below, which few views see."""

    place_m: float
    faces: float  # degrees, weighted by areas
    chords: float  # degrees: what the faces would have if their corners were exact
    normals: float  # degrees, of the normals in the file


def errors(result: FuseResult) -> Errors:
    ply, faces = read_ply_points(result.mesh_path), read_faces(result.mesh_path)
    inner = np.abs(ply.points[:, 1]) < 0.7 * RADIUS
    slope = gradient(field, ply.points)
    off = field(ply.points) / np.linalg.norm(slope, axis=-1)
    exact = ply.points - off[:, None] * unit(slope)
    corners = faces[inner[faces].all(axis=1)]

    def of_faces(points: np.ndarray) -> float:
        a, b, c = (points[corners[:, k]] for k in range(3))
        area = np.cross(b - a, c - a)
        size = np.linalg.norm(area, axis=1)
        whole = size > 0
        return float(np.sqrt(np.average(angle(area[whole], ((a + b + c) / 3)[whole]) ** 2, weights=size[whole])))

    return Errors(float(np.sqrt(np.mean(off[inner] ** 2))), of_faces(ply.points), of_faces(exact),
                  float(np.sqrt(np.mean(angle(ply.normals[inner].astype(float), ply.points[inner]) ** 2))))


def angle(found: np.ndarray, places: np.ndarray) -> np.ndarray:
    return np.degrees(2 * np.arcsin(np.linalg.norm(unit(found) - unit(gradient(field, places)), axis=1) / 2))


@pytest.mark.long
def test_the_joined_surface_has_the_place_of_the_depth_and_the_normals_of_the_photographs(tmp_path):
    """Normals that do not drift: tests/service/scans/fusion/test_joined_normals.py."""
    file = write_scans(tmp_path, shots(), sigma=DEPTH_SIGMA, maps=[
        photometric(field, shot, seed=number, noise_degrees=0.5, drift_degrees=3.0) for number, shot in enumerate(shots())])
    apart = fuse_scans(file, tmp_path / "apart", voxel_m=VOXEL)
    joined = fuse_scans(file, tmp_path / "joined", voxel_m=VOXEL, join_normals=True)
    before, after = errors(apart), errors(joined)
    assert after.place_m < 0.4 * before.place_m  # no worse than the depth alone is the reach of the issue
    assert after.faces < np.hypot(1.1 * before.normals, after.chords) < 0.5 * before.faces
    assert after.normals < 0.5 * before.normals
    assert joined.facts["joined_normals"]["vertices_share"] > 0.95 and joined.facts["vertices"] == apart.facts["vertices"]


def test_scans_without_maps_are_refused(tmp_path):
    file = write_scans(tmp_path, shots()[:1], sigma=DEPTH_SIGMA)
    with pytest.raises(RequestError, match=r"--join-normals: no scan of .* has photometric normals"):
        fuse_scans(file, tmp_path / "out", voxel_m=VOXEL, join_normals=True)
    assert not (tmp_path / "out").exists()
