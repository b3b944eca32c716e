"""Meshes of solved heights and of measured depths."""

import dataclasses

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from service.asset.content.depth import depth_mesh
from service.asset.content.links import Links, surface_links
from service.asset.content.mesh import BORDER_PX, height_mesh
from service.errors import AssetError
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps
from tests.scenes.surfaces import RADIUS_M, make_ball, make_sheet, make_wave
from tests.service.asset.content.manifold import check_manifold

CAMERA = Camera.model_validate({"projection": "perspective", "resolution": [120, 90], "focal_px": [288.0, 288.0]})
NEAR_M, FAR_M = 2.13, 2.31
"""A step of four pixels' footprints at 80°, as in real time-of-flight frames: mixed pixels make gentle slopes of it."""


def face_areas(mesh):
    """Area vectors of all faces as fans of triangles, one by one."""
    start = 0
    for count in mesh.face_counts:
        corners = mesh.points[mesh.face_indices[start:start + count]].astype(np.float64)
        yield sum(np.cross(corners[k] - corners[0], corners[k + 1] - corners[0]) / 2 for k in range(1, count - 1))
        start += count


def test_points_lie_on_the_sphere(ball):
    mesh = height_mesh(ball)
    assert mesh.centred > 200
    # the height is a float32 and x, y are rounded to float32: some 1e-8 on 0.08
    np.testing.assert_allclose(np.linalg.norm(mesh.points[:mesh.centred], axis=1), RADIUS_M, atol=2e-8)


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
    """A sheet of 4 × 6 pixels whose right third stands before the rest: both end at the edge between their pixels."""
    part = np.ones((4, 6), dtype=np.uint8)
    part[:, 4:] = 2
    maps = make_sheet(part > 0)
    whole, cut = (height_mesh(dataclasses.replace(maps, height=part.astype(np.float32), part=parts)) for parts in (None, part))
    assert whole.centred == cut.centred == 24
    assert np.ptp(whole.points[whole.quads][..., 2], axis=1).max() == 1
    assert (np.ptp(cut.points[cut.quads][..., 2], axis=1) == 0).all()
    assert (cut.normals == [0, 0, 1]).all()  # no wall between the parts bends the normals beside it
    left, right = (cut.points[cut.points[:, 2] == z, 0] for z in (1, 2))
    assert left.max() == pytest.approx(1, abs=2e-3) and right.min() == pytest.approx(1, abs=2e-3)  # 2 mm at a pixel of 1 m: BORDER_PX


def test_texture_coordinates_are_texel_centres(ball):
    mesh = height_mesh(ball)
    rows, cols = ball.mask.shape
    on_pixels = slice(mesh.centred)
    np.testing.assert_allclose(mesh.st[on_pixels, 0] * cols, mesh.cols[on_pixels] + 0.5, rtol=1e-6)
    np.testing.assert_allclose((1 - mesh.st[on_pixels, 1]) * rows, mesh.rows[on_pixels] + 0.5, rtol=1e-5)  # 1 - t loses a digit
    x, y = ball.camera.plane_coordinates()
    pixels = mesh.rows[on_pixels], mesh.cols[on_pixels]
    np.testing.assert_allclose(mesh.points[on_pixels, 0], x[pixels], atol=1e-8)
    np.testing.assert_allclose(mesh.points[on_pixels, 1], y[pixels], atol=1e-8)
    # the border lies inside of the texels of its pixels, so that the nearest texel is one of the object
    np.testing.assert_array_equal(np.floor(mesh.st[:, 0] * cols), mesh.cols)
    np.testing.assert_array_equal(np.floor((1 - mesh.st[:, 1]) * rows), mesh.rows)


def test_perspective_points_project_onto_their_pixels():
    maps = make_wave("perspective")
    mesh = height_mesh(maps)
    (fx, fy), (cu, cv) = maps.camera.focal_px, maps.camera.principal_px
    x, y, z = mesh.points.astype(np.float64).T
    u, v = mesh.st[:, 0] * maps.camera.width, (1 - mesh.st[:, 1]) * maps.camera.height
    np.testing.assert_allclose(cu + fx * x / -z, u, atol=2e-5)  # float32 points, 70 px focal length
    np.testing.assert_allclose(cv - fy * y / -z, v, atol=2e-5)
    on_pixels = slice(mesh.centred)
    np.testing.assert_allclose(u[on_pixels], mesh.cols[on_pixels] + 0.5, atol=2e-5)
    np.testing.assert_allclose(v[on_pixels], mesh.rows[on_pixels] + 0.5, atol=2e-5)


@pytest.mark.parametrize("rows, cols", [(2, 2), (3, 7), (20, 11)])
def test_counts_of_a_full_sheet(rows, cols):
    mesh = height_mesh(make_sheet(np.ones((rows, cols), dtype=bool)))
    border = 2 * (rows + cols)
    assert mesh.centred == rows * cols and len(mesh.points) == rows * cols + border
    assert len(mesh.quads) == (rows - 1) * (cols - 1) + border - 4 and len(mesh.triangles) == 4  # the corners
    assert mesh.face_counts.sum() == len(mesh.face_indices)
    np.testing.assert_allclose(mesh.normals, np.broadcast_to([0, 0, 1], mesh.normals.shape), atol=0)
    np.testing.assert_allclose(np.ptp(mesh.points[:, :2], axis=0), [cols - 1 + 2 * BORDER_PX, rows - 1 + 2 * BORDER_PX], rtol=1e-6)


def area(mask: np.ndarray) -> float:
    """What marching squares cover: every pixel, without an eighth at each corner that stands out, with one at each that turns in."""
    near = np.pad(mask, 1)
    count = near[:-1, :-1].astype(int) + near[1:, :-1] + near[1:, 1:] + near[:-1, 1:]
    diagonal = (count == 2) & (near[:-1, :-1] == near[1:, 1:])
    return mask.sum() + ((count == 3).sum() - (count == 1).sum() - 2 * diagonal.sum()) / 8


def test_three_pixels_and_their_border():
    for absent in range(4):
        mask = np.ones(4, dtype=bool)
        mask[absent] = False
        mesh = height_mesh(make_sheet(mask.reshape(2, 2)))
        assert mesh.centred == 3
        assert sum(face_areas(mesh))[2] == pytest.approx(area(mask.reshape(2, 2)), abs=0.02)  # BORDER_PX is not quite half a pixel


def test_hole_and_gap_in_the_mask_are_not_bridged():
    mask = np.ones((5, 9), dtype=bool)
    mask[2, 2] = False  # a hole
    mask[:, 5] = False  # a gap: two sheets
    mask[:, 8], mask[0, 8] = False, True  # a pixel that stands out
    mesh = height_mesh(make_sheet(mask))
    assert sum(face_areas(mesh))[2] == pytest.approx(area(mask), abs=0.05)
    assert mesh.centred == mask.sum()
    for face in [*mesh.quads, *mesh.triangles]:
        assert np.ptp(mesh.st[face, 0] * 9) <= 1 + 1e-6 and np.ptp(mesh.st[face, 1] * 5) <= 1 + 1e-6
        assert mask[mesh.rows[face], mesh.cols[face]].all()


def test_lone_pixels_lines_and_islands_get_no_vertex():
    mask = np.zeros((20, 20), dtype=bool)
    mask[:5, :5] = True
    mask[10, 4] = True  # a pixel
    mask[3, 5:12] = True  # a line of one pixel's width, away from the sheet
    mask[8:10, 14:17] = True  # an island
    mask[14:16, 14:18] = True  # a smaller sheet
    mesh = height_mesh(make_sheet(mask))
    found = np.zeros_like(mask)
    found[mesh.rows, mesh.cols] = True
    expected = np.zeros_like(mask)
    expected[:5, :5] = expected[3, 5] = expected[14:16, 14:18] = True  # a line begins with the pixel that has two neighbours in the sheet
    np.testing.assert_array_equal(found, expected)


def test_budget_skips_pixels():
    maps = make_sheet(np.ones((61, 41), dtype=bool))
    mesh = height_mesh(maps, vertex_budget=300)
    assert mesh.step == 3 and mesh.centred == 21 * 14 <= 300
    on_pixels = slice(mesh.centred)
    assert set(mesh.rows[on_pixels] % 3) == set(mesh.cols[on_pixels] % 3) == {0}
    np.testing.assert_allclose(mesh.st[on_pixels, 0], (mesh.cols[on_pixels] + 0.5) / 41, rtol=1e-6)
    np.testing.assert_allclose(mesh.points[:, :2].min(axis=0), [-20 - BORDER_PX, -30 - BORDER_PX], rtol=1e-6)  # still to the edge
    assert height_mesh(maps, vertex_budget=61 * 41).step == 1


def test_a_coarser_mesh_bridges_neither_gap_nor_break_nor_hole():
    mask = np.ones((61, 61), dtype=bool)
    mask[:, 20] = False  # between two pixels of the grid
    mask[40, 41] = False
    part = np.ones((61, 61), dtype=np.uint8)
    part[:, 32:] = 2
    mesh = height_mesh(dataclasses.replace(make_sheet(mask), height=part.astype(np.float32), part=part), vertex_budget=500)
    assert mesh.step == 3
    for face in [*mesh.quads, *mesh.triangles]:
        assert np.ptp(mesh.points[face, 2]) == 0
        assert (mesh.cols[face] < 20).all() or (mesh.cols[face] > 20).all()
        rows, cols = mesh.rows[face], mesh.cols[face]
        assert not (rows.min() <= 40 <= rows.max() and cols.min() <= 41 <= cols.max())


@pytest.mark.long
@pytest.mark.parametrize("step", [1, 2, 3])
@pytest.mark.parametrize("seed", range(8))
def test_meshes_are_manifold(seed, step):
    """Masks and breaks drawn by chance, with holes, bridges and breaks that end."""
    rng = np.random.default_rng(seed)
    mask = rng.random((37, 41)) < (0.55, 0.7, 0.85, 0.97)[seed % 4]
    height = rng.normal(size=mask.shape).astype(np.float32)
    sheet = make_sheet(mask)
    links = surface_links(sheet, mask)
    whole = rng.random((2, *mask.shape)) < (0.97 if seed > 3 else 0.8)
    links = Links(links.right & whole[0, :, 1:], links.down & whole[1, 1:])
    mesh = height_mesh(dataclasses.replace(sheet, height=height), links=links, vertex_budget=max(40, mask.sum() // step**2 + 40))
    faces = [*mesh.quads.tolist(), *mesh.triangles.tolist()]
    check_manifold(faces)
    assert {vertex for face in faces for vertex in face} == set(range(len(mesh.points)))
    flat = np.array([0, 0, 1])
    seen = [area_vector @ flat for area_vector in face_areas(mesh)]
    assert min(seen) > 1e-4  # no face is degenerate or turned
    assert len(np.unique(mesh.st, axis=0)) == len(mesh.st)  # the two vertices of two fans do not lie at one place


def test_heights_that_are_no_place_get_no_vertex():
    maps = make_wave("perspective")
    height = maps.height.copy()
    height[0, 0], height[0, 1], height[0, 2] = np.nan, np.inf, 0.3  # the last lies behind the camera
    mesh = height_mesh(dataclasses.replace(maps, height=height))
    assert mesh.centred == 600 - 3
    assert np.isfinite(mesh.points).all()


@pytest.mark.parametrize("mask", [np.zeros((4, 4)), np.eye(4), np.ones((1, 1)), np.ones((1, 5))],
                         ids=["empty", "diagonal", "1x1", "one row"])
def test_no_face_is_an_error(mask):
    with pytest.raises(AssetError, match="no face"):
        height_mesh(make_sheet(mask.astype(bool)))


def scene(inside):
    """A shape before a wall; each pixel is the mean of 8 × 8 places."""
    u, v = np.meshgrid((np.arange(120 * 8) + 0.5) / 8, (np.arange(90 * 8) + 0.5) / 8)
    share = inside(u, v).reshape(90, 8, 120, 8).mean(axis=(1, 3))
    rng = np.random.default_rng(7)
    depth = share * NEAR_M + (1 - share) * FAR_M + 0.002 * rng.standard_normal(share.shape)
    # readings of two surfaces disagree, so that edge pixels are unsure
    return DepthMaps(camera=CAMERA, mask=np.ones(share.shape, bool), depth=depth.astype(np.float32),
                     sigma=np.where((share > 0) & (share < 1), 0.03, 0.002).astype(np.float32)), share


def pieces(mesh):
    """The number of the piece of each vertex."""
    edges = np.concatenate([np.stack([faces, np.roll(faces, 1, axis=1)], axis=-1).reshape(-1, 2) for faces in (mesh.quads, mesh.triangles)])
    return connected_components(coo_array((np.ones(len(edges)), edges.T), shape=2 * (len(mesh.points),)), directed=False)[1]


@pytest.mark.parametrize("inside", [
    lambda u, v: np.hypot(u - 61.3, v - 44.2) < 27,
    lambda u, v: np.abs(0.8 * (u - 60) + 0.6 * (v - 45)) + np.abs(-0.6 * (u - 60) + 0.8 * (v - 45)) < 25,
    lambda u, v: (np.abs(u - 60.4 - 0.4 * (v - 45)) < 12) & (np.abs(v - 45) < 30),
], ids=["disc", "turned square", "slanted bar"])
def test_mixed_pixels_are_no_bridge(inside):
    maps, share = scene(inside)
    mesh = depth_mesh(maps)
    label = pieces(mesh)
    near, far = (np.unique(label[share[mesh.rows, mesh.cols] == part]) for part in (1.0, 0.0))
    assert len(near) == len(far) == 1 and near != far
    covered = np.zeros(share.shape, bool)
    covered[mesh.rows, mesh.cols] = True
    assert covered[(share == 0) | (share == 1)].mean() > 0.999
    for faces in (mesh.quads, mesh.triangles):
        assert np.ptp(mesh.points[faces, 2], axis=1).max() < 0.6 * (FAR_M - NEAR_M)
