"""Range images of shapes with a closed form, fused and measured against it; all vertices count."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.fusion.bricks import BLOCK, BRICK_VOXELS, VOXELS, Blocks, find_blocks
from kernels.fusion.extract import extract
from kernels.fusion.integrate import SURFACE, Volume, integrate
from kernels.fusion.views import upload_views
from tests.kernels.fusion.scene import edge_counts, fuse, range_image
from tests.scenes.statue import place, shoot

SIGMA = 5e-4
RADIUS = 0.1
BOX = (-0.14,) * 3, (0.14,) * 3


def sphere(points):
    return np.linalg.norm(points, axis=-1) - RADIUS


def around(scene, *, count=8, sigma=SIGMA, side=(120, 120), range_m=0.8, wide=0.3):
    """Range images from all sides, two heights in turn, and one from above and one from below."""
    focal = side[0] * range_m / wide
    poses = [place(2 * np.pi * k / count, 0.45 * (-1) ** k, range_m) for k in range(count)]
    poses += [place(0.3, height, 0.02) for height in (range_m, -range_m)]
    return [shoot(pose, side, focal, sigma=sigma, seed=k, scene=scene) for k, pose in enumerate(poses)]


def test_every_pattern_of_signs_gives_a_closed_surface(device):
    """Random signs have all 256 cases and all ambiguous faces; where the border is outside, every edge has two faces."""
    rng = np.random.default_rng(0)
    values = rng.uniform(0.1, 1, (BLOCK,) * 3) * rng.choice([-1, 1], (BLOCK,) * 3)
    for axis in range(3):
        for end in (0, -1):
            np.moveaxis(values, axis, 0)[end] = 1.0
    index = np.full((2, 2, 2), -1, dtype=np.int32)
    index[0, 0, 0] = 0
    blocks = Blocks(wp.array(index, dtype=int, device=device), wp.zeros(1, dtype=wp.vec3i, device=device), 1, (0, 0, 0), 1.0, device)
    volume = Volume(blocks, wp.array(values.ravel(), dtype=float, device=device), wp.zeros(VOXELS, dtype=float, device=device),
                    wp.full(VOXELS, SURFACE, dtype=wp.uint8, device=device))
    found = extract(volume)
    assert edge_counts(found.faces).tolist() == [0, 0, len(found.faces) * 3 // 2]
    corners = found.points[found.faces].astype(np.float64)
    enclosed = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert enclosed > 0  # the faces look outwards


@pytest.fixture(scope="module")
def sphere_shots():
    return around(sphere)


def test_a_sphere_is_closed_and_as_sure_as_it_says(device, sphere_shots):
    images = [range_image(shot, SIGMA) for shot in sphere_shots]
    points, sigma, faces = fuse(images, 2.5e-3, *BOX, device=device)
    error = sphere(points)
    assert edge_counts(faces)[:2].tolist() == [0, 0] and len(edge_counts(faces)) == 3
    assert np.median(np.abs(error)) < 0.6745 * SIGMA / np.sqrt(3)  # each point is seen by three views or more
    assert abs(np.mean(error)) < 0.1 * SIGMA  # pixels of 2.5 mm see chords 8 µm below it, and more at an angle
    normalised = error / sigma
    assert 0.5 < np.sqrt(np.mean(normalised**2)) < 1.1  # LATERAL allows for an error of 0.25 mm that this camera does not have


@pytest.mark.long
def test_without_noise_only_the_chords_between_pixels_are_left(device):
    images = [range_image(shot, SIGMA) for shot in around(sphere, sigma=0.0)]
    points, _, _ = fuse(images, 2.5e-3, *BOX, device=device)
    assert np.abs(sphere(points)).max() < 2.1e-4  # (2.5 mm / cos 78°)² / 8 R = 0.18 mm at the most grazing pixels, and voxels


@pytest.mark.long
@pytest.mark.parametrize("voxels", [2.0, 4.0, 8.0])
def test_a_small_ball_before_a_wall_is_whole(device, voxels):
    """Views that see the wall past the ball see the voxels beside it to be empty, and they are: the surface lies behind them."""
    voxel = 0.03 / voxels
    shots = around(lambda points: np.minimum(np.linalg.norm(points, axis=-1) - 0.03, 1.2 - np.linalg.norm(points, axis=-1)))
    points, _, _ = fuse([range_image(shot, SIGMA) for shot in shots], voxel, (-0.05,) * 3, (0.05,) * 3, blocks=4, device=device)
    points = points[np.linalg.norm(points, axis=1) < 0.1]
    direction = np.random.default_rng(5).normal(size=(1000, 3))
    ball = 0.03 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    nearest = np.linalg.norm(ball[:, None] - points, axis=-1).min(axis=1, initial=1.0)
    assert (nearest < voxel).mean() > 0.98  # a cell that is crossed has such vertices; noise opens one cell at four voxels
    assert np.median(np.abs(np.linalg.norm(points, axis=1) - 0.03)) < 0.15 * voxel


@pytest.mark.long
def test_bricks_meet_without_seams_and_crops_change_nothing(device, sphere_shots):
    """A surface over eight bricks is the surface of one, moved: every vertex lies on an edge that two bricks compute alike."""
    voxel = 2.5e-3
    images = [range_image(shot, SIGMA) for shot in sphere_shots]
    views = upload_views(images, np.zeros(3), device=device)
    one = extract(integrate(find_blocks(views, voxel, (-64, -64, -64), device=device), views))
    parts, _, faces = fuse(images, voxel, *BOX, device=device)
    assert len(faces) == len(one.faces) and np.array_equal(parts, one.points[np.lexsort(one.edge.T[::-1])])
    small, _, small_faces = fuse(images, voxel, *BOX, blocks=4, device=device)  # 27 boxes that the sphere comes into
    assert np.array_equal(small, parts) and len(small_faces) == len(faces)
    cropped = upload_views([image.cropped(10, 110, 5, 115) for image in images], np.zeros(3), device=device)  # all of the sphere
    again = extract(integrate(find_blocks(cropped, voxel, (-64, -64, -64), device=device), cropped))
    assert np.array_equal(again.points, one.points)


THICK = 4e-3


def sheet(points):
    q = np.abs(points) - [0.08, 0.08, THICK / 2]
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


@pytest.mark.long
def test_a_sheet_thinner_than_the_truncation_keeps_its_thickness(device):
    """Both sides are within the truncation of each other: means of both would push them apart."""
    images = [range_image(shot, SIGMA) for shot in around(sheet)]
    points, _, _ = fuse(images, 1.25e-3, *BOX, device=device)
    flat = (np.abs(points[:, :2]) < 0.07).all(axis=1)
    for side in (-1, 1):
        error = side * points[flat & (np.sign(points[:, 2]) == side), 2] - THICK / 2
        assert len(error) > 5000 and abs(np.median(error)) < 0.1 * SIGMA and np.percentile(np.abs(error), 99) < 3 * SIGMA


def two_plates(points):
    gap = 1e-2  # four pixels
    distances = [np.abs(points - [0, 0, side * (0.03 + gap / 2)]) - [0.08, 0.08, 0.03] for side in (-1, 1)]
    return np.min([np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0) for q in distances], axis=0)


@pytest.mark.long
def test_a_gap_and_a_step_are_not_bridged(device):
    images = [range_image(shot, SIGMA) for shot in around(two_plates)]
    points, _, _ = fuse(images, 1.25e-3, *BOX, device=device)
    outside = two_plates(points)
    assert np.percentile(outside, 99) < 1.5e-3 and outside.max() < 2 * 2.5e-3 + 1e-6  # two pixels, at the mouth of the gap
    middle = np.abs(points[:, 2]) < 2.5e-3
    assert middle.mean() < 2e-3  # pixels that see the edge of one plate beside the wall of the other
    assert (np.abs(points[middle, :2]).max(axis=1) > 0.08 - 2 * 2.5e-3).all()  # two pixels behind the mouth at the most


@pytest.mark.long
def test_points_that_one_view_sees_and_the_others_see_through_are_no_surface(device):
    """A patch of wrong depths 3 cm before the sphere, in one view of eighteen; those beside it look through them."""
    shots = around(sphere, count=16)
    wrong = shots[0].depth.copy()
    wrong[55:65, 55:65] -= 0.03
    shots[0] = shots[0]._replace(depth=wrong)
    points, _, _ = fuse([range_image(shot, SIGMA) for shot in shots], 2.5e-3, *BOX, device=device)
    assert sphere(points).max() < 5e-3
    alone, _, _ = fuse([range_image(shots[0], SIGMA)], 2.5e-3, *BOX, device=device)
    assert sphere(alone).max() > 2.5e-2  # it was there


def test_wrong_arrays_are_refused(sphere_shots):
    image = range_image(sphere_shots[0], SIGMA)
    with pytest.raises(ArrayError, match="sigma of view 0 has shape"):
        upload_views([image._replace(sigma=image.sigma[:-1])], np.zeros(3), device="cpu")
    with pytest.raises(ArrayError, match="not above 0"):
        upload_views([image._replace(sigma=0 * image.sigma)], np.zeros(3), device="cpu")
    assert BRICK_VOXELS % BLOCK == 0
