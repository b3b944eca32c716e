"""Height map → mesh, against closed forms."""

import dataclasses

import numpy as np
import pytest

from service.asset.errors import AssetError
from service.asset.mesh import height_mesh
from tests.scenes.surfaces import RADIUS_M, make_ball, make_sheet, make_wave


def face_areas(mesh):
    """Area vectors of all faces as fans of triangles, one by one."""
    start = 0
    for count in mesh.face_counts:
        corners = mesh.points[mesh.face_indices[start:start + count]].astype(np.float64)
        yield sum(np.cross(corners[k] - corners[0], corners[k + 1] - corners[0]) / 2 for k in range(1, count - 1))
        start += count


def test_points_lie_on_the_sphere(ball):
    mesh = height_mesh(ball)
    assert len(mesh.points) > 200
    # the height is a float32 and x, y are rounded to float32: some 1e-8 on 0.08
    np.testing.assert_allclose(np.linalg.norm(mesh.points, axis=1), RADIUS_M, atol=2e-8)


def test_faces_are_counter_clockwise_for_the_viewer(ball):
    for maps in (ball, make_wave("orthographic"), make_wave("perspective")):
        mesh = height_mesh(maps)
        towards_viewer = np.array([0, 0, 1]) if maps.camera.projection == "orthographic" else -mesh.points.mean(axis=0)
        assert all(area @ towards_viewer > 0 for area in face_areas(mesh))


def test_normals_are_those_of_the_sphere(ball):
    mesh = height_mesh(make_ball(96))
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)  # float32
    expected = mesh.points / RADIUS_M
    cosine = np.einsum("vx,vx->v", mesh.normals, expected)
    assert cosine.min() > np.cos(np.radians(6))  # at the edge of the mask half of the faces are missing
    inner = expected[:, 2] > 0.6
    # symmetric differences: the error is of second order, (pixel / radius)² = 0.04° in the middle, more on the slope
    assert np.degrees(np.arccos(np.clip(cosine[inner], -1, 1))).max() < 0.2


def test_normals_are_area_weighted():
    maps = make_sheet(np.ones((2, 3), dtype=bool))
    height = np.array([[0, 0, 2], [0, 0, 2]], dtype=np.float32)  # a flat quad beside one that rises by 2
    mesh = height_mesh(dataclasses.replace(maps, height=height))
    expected = np.array([0, 0, 1]) + np.array([-2, 0, 1])  # area vectors
    np.testing.assert_allclose(mesh.normals[1], expected / np.linalg.norm(expected), atol=1e-6)


def test_no_face_leads_from_part_to_part():
    """A sheet of 4 × 6 pixels whose right third stands before the rest: the column of faces between is left out, and no vertex is."""
    part = np.ones((4, 6), dtype=np.uint8)
    part[:, 4:] = 2
    maps = make_sheet(part > 0)
    whole, cut = (height_mesh(dataclasses.replace(maps, height=part.astype(np.float32), part=parts)) for parts in (None, part))
    assert (len(whole.quads), len(cut.quads), len(cut.points)) == (15, 12, 24)
    assert (np.ptp(cut.points[cut.quads][..., 2], axis=1) == 0).all()
    assert (cut.normals == [0, 0, 1]).all()  # no wall between the parts bends the normals beside it


def test_texture_coordinates_are_texel_centres(ball):
    mesh = height_mesh(ball)
    rows, cols = ball.mask.shape
    np.testing.assert_allclose(mesh.st[:, 0] * cols, mesh.cols + 0.5, rtol=1e-6)
    np.testing.assert_allclose((1 - mesh.st[:, 1]) * rows, mesh.rows + 0.5, rtol=1e-5)  # 1 - t loses a digit
    x, y = ball.camera.plane_coordinates()
    np.testing.assert_allclose(mesh.points[:, 0], x[mesh.rows, mesh.cols], atol=1e-8)
    np.testing.assert_allclose(mesh.points[:, 1], y[mesh.rows, mesh.cols], atol=1e-8)


def test_perspective_points_project_onto_their_pixels():
    maps = make_wave("perspective")
    mesh = height_mesh(maps)
    (fx, fy), (cu, cv) = maps.camera.focal_px, maps.camera.principal_px
    x, y, z = mesh.points.astype(np.float64).T
    np.testing.assert_allclose(cu + fx * x / -z, mesh.cols + 0.5, atol=2e-5)  # float32 points, 70 px focal length
    np.testing.assert_allclose(cv - fy * y / -z, mesh.rows + 0.5, atol=2e-5)


def test_extent_is_tight(ball):
    mesh = height_mesh(ball)
    np.testing.assert_array_equal(mesh.extent, [mesh.points.min(axis=0), mesh.points.max(axis=0)])


@pytest.mark.parametrize("rows, cols", [(2, 2), (3, 7), (20, 11)])
def test_counts_of_a_full_sheet(rows, cols):
    mesh = height_mesh(make_sheet(np.ones((rows, cols), dtype=bool)))
    assert len(mesh.points) == rows * cols
    assert mesh.quads.shape == ((rows - 1) * (cols - 1), 4) and mesh.triangles.shape == (0, 3)
    assert mesh.face_counts.sum() == len(mesh.face_indices)
    np.testing.assert_allclose(mesh.normals, np.broadcast_to([0, 0, 1], mesh.normals.shape), atol=0)


def test_three_pixels_make_one_triangle():
    for absent in range(4):
        mask = np.ones(4, dtype=bool)
        mask[absent] = False
        mesh = height_mesh(make_sheet(mask.reshape(2, 2)))
        assert len(mesh.points) == 3 and mesh.face_counts.tolist() == [3]
        assert next(face_areas(mesh)).tolist() == [0, 0, 0.5]


def test_hole_and_step_in_the_mask_are_not_bridged():
    mask = np.ones((5, 9), dtype=bool)
    mask[2, 2] = False  # a hole: four quads become triangles
    mask[:, 5] = False  # a gap: two sheets
    mask[:, 8], mask[0, 8] = False, True  # a lone pixel: no face, so no vertex
    mesh = height_mesh(make_sheet(mask))
    assert len(mesh.quads) == 4 * 4 - 4 + 4 * 1
    assert len(mesh.triangles) == 4 + 1  # the lone pixel closes one triangle with its neighbours
    assert sum(area[2] for area in face_areas(mesh)) == 12 + 4 + 2.5
    assert len(mesh.points) == len(np.unique(mesh.face_indices)) == 24 + 10 + 1
    for face in [*mesh.quads, *mesh.triangles]:
        assert np.ptp(mesh.cols[face]) == 1 and np.ptp(mesh.rows[face]) == 1


def test_lone_pixels_get_no_vertex():
    mask = np.zeros((6, 6), dtype=bool)
    mask[:2, :2] = True
    mask[4, 4] = True
    mesh = height_mesh(make_sheet(mask))
    assert len(mesh.points) == 4 and mesh.face_indices.max() == 3


def test_budget_skips_pixels():
    maps = make_sheet(np.ones((61, 41), dtype=bool))
    mesh = height_mesh(maps, vertex_budget=300)
    assert mesh.step == 3 and len(mesh.points) == 21 * 14 <= 300
    assert set(mesh.rows % 3) == set(mesh.cols % 3) == {0}
    np.testing.assert_allclose(mesh.st[:, 0], (mesh.cols + 0.5) / 41, rtol=1e-6)
    assert height_mesh(maps, vertex_budget=61 * 41).step == 1


def test_heights_that_are_no_place_get_no_vertex():
    maps = make_wave("perspective")
    height = maps.height.copy()
    height[0, 0], height[0, 1], height[0, 2] = np.nan, np.inf, 0.3  # the last lies behind the camera
    mesh = height_mesh(dataclasses.replace(maps, height=height))
    assert len(mesh.points) == 600 - 3
    assert np.isfinite(mesh.points).all()


def test_no_height_is_an_error(ball):
    with pytest.raises(AssetError, match="no height layer"):
        height_mesh(dataclasses.replace(ball, height=None))


@pytest.mark.parametrize("mask", [np.zeros((4, 4)), np.eye(4), np.ones((1, 1)), np.ones((1, 5))],
                         ids=["empty", "diagonal", "1x1", "one row"])
def test_no_face_is_an_error(mask):
    with pytest.raises(AssetError, match="no face"):
        height_mesh(make_sheet(mask.astype(bool)))
