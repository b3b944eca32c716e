"""Holes of meshes whose boundaries are known, and the file of a mesh."""

import numpy as np
import pytest

from service.comparison.surfaces import read_design, read_scanned
from service.scans.fusion.holes import find_holes
from service.scans.points.ply_points import read_ply_points
from stage.errors import ResultError
from stage.results.mesh import TriangleMesh, write_mesh_ply
from tests.service.scans.mesh_files import read_faces

SIDE = 0.01


def sheet(rows: int, cols: int, missing=()) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of squares of two triangles each, without those at `missing`."""
    row, col = np.mgrid[:rows + 1, :cols + 1]
    points = np.stack([SIDE * col.ravel(), SIDE * row.ravel(), np.zeros(row.size)], axis=-1).astype(np.float32)
    faces = []
    for r in range(rows):
        for c in range(cols):
            if (r, c) not in missing:
                a = r * (cols + 1) + c
                faces += [(a, a + 1, a + cols + 2), (a, a + cols + 2, a + cols + 1)]
    return points, np.array(faces, dtype=np.int32)


def test_the_boundary_of_a_sheet_and_of_a_hole_in_it():
    points, faces = sheet(6, 8, {(2, 3), (2, 4)})
    found = find_holes(points, faces)
    assert [hole.closed for hole in found.holes] == [True, True]
    assert found.holes[0].length_m == pytest.approx(28 * SIDE, rel=1e-5)
    assert found.holes[1].length_m == pytest.approx(6 * SIDE, rel=1e-5)
    assert found.holes[1].area_m2 == pytest.approx(2 * SIDE**2, rel=1e-5)
    assert found.holes[1].centre[:2] == pytest.approx([4 * SIDE, 2.5 * SIDE], rel=1e-5)
    assert (found.open_edges, found.shared_edges) == (34, 0)
    assert found.open_length_m == pytest.approx(34 * SIDE, rel=1e-5)
    assert found.area_m2 == pytest.approx(46 * SIDE**2, rel=1e-5)


def test_holes_that_meet_at_a_vertex_lose_no_edge():
    points, faces = sheet(6, 6, {(2, 2), (3, 3)})
    found = find_holes(points, faces)
    assert sum(hole.edges for hole in found.holes) == found.open_edges == 24 + 8


def test_a_closed_surface_has_no_hole_and_a_fin_is_counted():
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=np.float32)
    tetrahedron = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)], dtype=np.int32)
    assert find_holes(corners, tetrahedron).holes == []
    finned = np.concatenate([tetrahedron, [(1, 0, 4)]]).astype(np.int32)
    assert find_holes(np.concatenate([corners, [(1, -1, 0)]]).astype(np.float32), finned).shared_edges == 1


def test_a_mesh_is_written_as_it_is(tmp_path):
    points, faces = sheet(2, 3)
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 256, points.shape).astype(np.uint8)
    normals = np.tile(np.array([0, 0, 1], dtype=np.float32), (len(points), 1))
    sigma = rng.random(len(points)).astype(np.float32)
    write_mesh_ply(TriangleMesh(points, normals, sigma, np.ones(len(points), np.uint16), colours, faces), tmp_path / "mesh.ply")
    read = read_ply_points(tmp_path / "mesh.ply")
    assert read.normals is not None and read.sigma is not None and read.colours is not None
    for one, other in ((read.points, points), (read.normals, normals), (read.sigma, sigma), (read.colours, colours)):
        assert np.array_equal(one, other)
    assert np.array_equal(read_faces(tmp_path / "mesh.ply"), faces)


def test_what_is_invented_is_left_out_where_a_mesh_is_read(tmp_path):
    points, faces = sheet(12, 12)
    invented = points[:, 0] > 8.5 * SIDE
    normals = np.tile(np.array([0, 0, 1], dtype=np.float32), (len(points), 1))
    sigma = np.where(invented, np.nan, 1e-4).astype(np.float32)
    path = tmp_path / "mesh.ply"
    write_mesh_ply(TriangleMesh(points, normals, sigma, (~invented).astype(np.uint16), None, faces, invented), path)
    scan = read_scanned(path, 1.0, None)
    np.testing.assert_array_equal(scan.points, points[~invented])
    assert len(scan.faces) == 2 * 8 * 12 and np.isfinite(scan.sigma).all()
    np.testing.assert_allclose(scan.points[scan.faces].mean(axis=1)[:, 0].max(), (7 + 2 / 3) * SIDE, rtol=1e-6)
    with pytest.raises(ResultError, match="invented to close holes"):
        read_design(path, 1.0, device="cpu")
