"""Breaks and normals of a depth map."""

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.results.depth_breaks import connected, same_surface
from stage.results.depth_normals import depth_normals
from tests.reference import projector as reference
from tests.scenes.captures import angles_degrees

SHAPE = reference.Device(96, 72, 80.0)
CAMERA = Camera.model_validate({"projection": "perspective", "resolution": [96, 72], "focal_px": [80.0, 80.0],
                                "principal_px": SHAPE.principal.tolist()})
RAYS = reference.pixel_rays(SHAPE)
FLOOR, BOARD, PILLAR, BALL, WALL = 1, 2, 3, 4, 5
DOWN, RIGHT = (1, 0), (0, 1)
WINDOW = reference.Device(60, 44, 90.0, (-0.1, 0.02, 0.0), (0.001, -0.001))
NORMALS_CAMERA = Camera.model_validate({
    "projection": "perspective", "resolution": [60, 44], "focal_px": [90.0, 90.0], "principal_px": WINDOW.principal.tolist(),
    "distortion": {"model": "brown_conrady", "k": WINDOW.k, "p": WINDOW.p}})
NORMALS_RAYS = reference.pixel_rays(WINDOW)
ALL = np.ones((44, 60), bool)


def nearest(*surfaces):
    """Depth [rows, cols] and label of the nearest of (label, depth) maps with NaN where a line of sight misses; 0 where all are missed."""
    depths = np.stack([np.where(np.isfinite(depth) & (depth > 0), depth, np.inf) for _, depth in surfaces])
    first = depths.argmin(axis=0)
    depth = np.take_along_axis(depths, first[None], axis=0)[0]
    label = np.where(np.isfinite(depth), np.array([label for label, _ in surfaces])[first], 0)
    return np.where(np.isfinite(depth), depth, 0), label


def board(z, left, right, bottom, top):
    """A rectangle that faces the camera."""
    x, y = RAYS[..., 0] * z, RAYS[..., 1] * z
    return np.where((x > left) & (x < right) & (y > bottom) & (y < top), z, np.nan)


def hall(wall_m):
    """A floor 1.1 m below the camera with a board, a pillar and a ball on it, and a wall or the horizon."""
    with np.errstate(divide="ignore", over="ignore"):
        floor = reference.plane_depth(RAYS, (0.0, -1.1, 0.0), (0.04, 1.0, 0.0))
    surfaces = [(FLOOR, floor), (BOARD, board(3.1, -1.4, -0.6, -1.1, 0.3)), (PILLAR, board(7.5, 0.9, 1.5, -1.1, 0.5)),
                (BALL, reference.sphere_depth(RAYS, (0.5, -0.7, -3.6), 0.4))]
    return nearest(*surfaces, *([] if wall_m is None else [(WALL, np.full(floor.shape, wall_m))]))


def pairs(values, offset):
    """Values of the pixels that have a neighbour at an offset, and of the neighbours."""
    return (values[:-1], values[1:]) if offset == DOWN else (values[:, :-1], values[:, 1:])


def counted(depth, label, truth, sigma):
    """Return pairs on one surface, those of them that are taken for breaks, clear breaks, and those of them that are joined."""
    numbers = np.zeros(4, int)
    for offset in (DOWN, RIGHT):
        joined = pairs(connected(depth, label > 0, CAMERA, offset, sigma=sigma), offset)[0]
        (one, other), (near, far) = pairs(label, offset), pairs(truth, offset)
        measured = (one > 0) & (other > 0)
        same = measured & (one == other)
        noise = 0 if sigma is None else np.maximum(*pairs(sigma, offset))
        meet = (np.minimum(one, other) == FLOOR) & (np.maximum(one, other) == WALL)
        clear = measured & ~same & ~meet & ~same_surface(near, far, 1.0, CAMERA) & (np.abs(near - far) > 10 * noise)
        numbers += [same.sum(), (same & ~joined).sum(), clear.sum(), (clear & joined).sum()]
    return numbers


@pytest.mark.parametrize("wall_m", [None, 11.0])
def test_a_floor_holds_together_up_to_the_horizon_and_objects_stand_free(wall_m):
    depth, label = hall(wall_m)
    gentle = sum(int((pairs(label, o)[0] == pairs(label, o)[1])[~same_surface(*pairs(depth, o), 1.0, CAMERA)].sum()) for o in (DOWN, RIGHT))
    same, torn, breaks, joined = counted(depth, label, depth, None)
    assert gentle > 60 and breaks > 100  # an 80° rule alone tears the floor
    # strips of the floor that are narrower than the four pixels of a line, and the ball's rim
    assert torn <= 0.005 * same
    assert joined == 0


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_noise_is_no_break_and_no_excuse_for_one(scale):
    depth, label = hall(11.0)
    sigma = scale * (0.008 + 0.0015 * depth**2)  # 8 to 190 mm: that of a small time-of-flight camera, and worse
    noisy = np.where(label > 0, depth + sigma * np.random.default_rng(3).standard_normal(depth.shape), 0)
    same, torn, breaks, joined = counted(noisy, label, depth, sigma)
    assert torn <= 0.01 * same  # three standard deviations, and strips of the floor that are too narrow
    assert breaks > 100 and joined <= 0.01 * breaks  # gaps of ten standard deviations
    blind = counted(noisy, label, depth, None)
    assert blind[1] > 5 * torn  # sigma is what tells


def test_batches_change_nothing(monkeypatch):
    depth, label = hall(11.0)
    whole = connected(depth, label > 0, CAMERA, DOWN)
    monkeypatch.setattr("stage.results.depth_breaks.BATCH", 7)
    assert (connected(depth, label > 0, CAMERA, DOWN) == whole).all()


def test_a_pixel_that_mixes_two_surfaces_joins_neither():
    depth = np.where(np.arange(96) < 40, 2.0, 5.0) * np.ones((72, 96))
    for width in (1, 2):
        mixed = depth.copy()
        mixed[:, 40:40 + width] = 1 / np.linspace(1 / 2.0, 1 / 5.0, width + 2)[1:-1]
        joined = connected(mixed, np.ones(depth.shape, bool), CAMERA, RIGHT, sigma=np.full(depth.shape, 0.002))
        assert not joined[:, 39:40 + width].any()
        assert joined[:, :39].all() and joined[:, 40 + width:-1].all()


def test_one_unsure_pixel_is_no_bridge():
    depth = np.where(np.arange(96) < 40, 2.0, 3.0) * np.ones((72, 96))
    sigma = np.full(depth.shape, 0.005)
    sigma[:, 40] = 1.0  # an edge pixel
    assert not connected(depth, np.ones(depth.shape, bool), CAMERA, RIGHT, sigma=sigma)[:, 39].any()


def test_pixels_at_the_camera_are_not_joined_to_the_scene():
    """As when a range wraps: their inverse depth is large, and so would be its standard deviation."""
    depth = np.where(np.arange(96) < 40, 0.01, 2.4) * np.ones((72, 96)) + 0.002 * np.random.default_rng(6).random((72, 96))
    for sigma in (0.004, 0.02):
        joined = connected(depth, np.ones(depth.shape, bool), CAMERA, RIGHT, sigma=np.full(depth.shape, sigma))
        assert not joined[:, 39].any()


@pytest.mark.parametrize("degrees", [60, 82, 87, 89])
def test_a_slanted_plane_holds_together_in_every_direction(degrees):
    slant = np.radians(degrees)
    depth = reference.plane_depth(RAYS, (0.0, 0.0, -2.0), (np.sin(slant), 0.0, np.cos(slant)))
    mask = (depth > 0) & (depth < 1e3)
    assert mask.sum() > 500
    for offset in (DOWN, RIGHT, (1, 1), (1, -1), (2, 1)):
        joined = connected(np.where(mask, depth, 1), mask, CAMERA, offset)
        rows, cols = np.argwhere(mask[8:-8]).T + [[8], [0]]  # in a corner of the image a diagonal is shorter than a line needs
        row, col = rows + offset[0], cols + offset[1]
        inside = (col >= 0) & (col < 96)
        both = inside & mask[row, np.where(inside, col, 0)]
        assert (joined[rows, cols] == both).all()


def test_an_orthographic_camera_takes_depth_for_inverse_depth():
    camera = Camera.model_validate({"projection": "orthographic", "resolution": [40, 30], "pixel_size_m": 0.01})
    depth = 1 + 0.1 * np.arange(40) * np.ones((30, 1))  # 84 degrees
    depth[:, 25:] += 2
    joined = connected(depth, np.ones((30, 40), bool), camera, RIGHT)
    assert joined[:, :24].all() and not joined[:, 24].any() and joined[:, 25:39].all()


def test_small_images_and_offsets_beyond_them():
    depth = np.ones((1, 1))
    for offset in (DOWN, RIGHT, (1, -1), (3, 2)):
        assert not connected(depth, depth > 0, CAMERA, offset).any()


@pytest.mark.parametrize("radius", [1, 2])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.4, 1.0), (-1.2, 0.3, 0.9)])
def test_a_plane_has_its_normal_everywhere(normal, radius):
    depth = reference.plane_depth(NORMALS_RAYS, (0.0, 0.0, -2.0), normal)
    found = depth_normals(depth, ALL, NORMALS_CAMERA, radius=radius)
    # corners have only three neighbours
    assert angles_degrees(found[1:-1, 1:-1], normal / np.linalg.norm(normal)).max() < 1e-3  # float32


def test_a_sphere(monkeypatch):
    depth = reference.sphere_depth(NORMALS_RAYS, (0.1, 0.0, -2.0), 0.6)
    mask = np.isfinite(depth)
    found = depth_normals(np.nan_to_num(depth, nan=0.0), mask, NORMALS_CAMERA)
    truth = (NORMALS_RAYS * np.nan_to_num(depth)[..., None] - (0.1, 0.0, -2.0)) / 0.6
    middle = mask & (truth[..., 2] > 0.8)
    assert angles_degrees(found[middle], truth[middle]).max() < 1.5  # a pixel spans two degrees of the sphere
    assert not found[~mask].any()
    monkeypatch.setattr("stage.results.depth_normals.ROWS", 7)  # bands change nothing
    assert (depth_normals(np.nan_to_num(depth, nan=0.0), mask, NORMALS_CAMERA) == found).all()


def test_nothing_is_fitted_across_a_break():
    depth = np.where(np.arange(60) < 30, 1.0, 2.0) * np.ones((44, 60))
    assert np.abs(depth_normals(depth, ALL, NORMALS_CAMERA)[1:-1, 1:-1] - (0, 0, 1)).max() < 1e-6


def test_pixels_without_neighbours_have_none():
    mask = np.zeros((44, 60), bool)
    mask[10, 10], mask[20] = True, True  # one alone; one row, which spans no plane
    assert not depth_normals(np.ones((44, 60)), mask, NORMALS_CAMERA).any()


def test_a_floor_has_normals_up_to_the_horizon():
    with np.errstate(divide="ignore"):
        depth = reference.plane_depth(NORMALS_RAYS, (0.0, -0.3, 0.0), (0.0, 1.0, 0.0))
    mask = (depth > 0) & (depth < 20)
    grazing = mask & (depth > 0.3 * 8)  # steeper than 80°
    assert grazing.sum() > 60
    found = depth_normals(np.where(mask, depth, 0), mask, NORMALS_CAMERA)
    assert angles_degrees(found[grazing], np.array([0.0, 1.0, 0.0])).max() < 0.05  # float32


def test_noise_takes_no_normal_away():
    depth = reference.plane_depth(NORMALS_RAYS, (0.0, 0.0, -3.0), (0.2, 0.1, 1.0))
    sigma = np.full(depth.shape, 0.15)  # a step to a neighbour is often steeper than 80°
    noisy = depth + sigma * np.random.default_rng(5).standard_normal(depth.shape)
    missing, blind = (int((~depth_normals(noisy, ALL, NORMALS_CAMERA, sigma=given).any(axis=-1)).sum()) for given in (sigma, None))
    assert missing == 0 and blind > 10
