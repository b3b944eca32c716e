"""Which mirroring or turn of a surface's normals is found, and that none is where nothing tells them apart."""

import numpy as np
import pytest

from service.light_estimation.axes import LEAST_SITES, SITES, sites, wrong_axes
from tests.scenes.ellipsoid import ellipsoid

SCENE = ellipsoid()
NORMAL = np.moveaxis(SCENE.normal, -1, 0).reshape(3, -1)


def at_sites(normal, mask=SCENE.mask):
    return np.moveaxis(normal[:, sites(mask).reshape(-1)].reshape(3, 4, -1), 1, 0)


def turn(degrees):
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def test_sites_are_pixels_of_the_mask_around_one_middle():
    right, left, above, below = (np.stack(np.divmod(part, SCENE.mask.shape[1])) for part in sites(SCENE.mask))
    assert 1000 < right.shape[1] <= SITES
    assert all(SCENE.mask[tuple(part)].all() for part in (right, left, above, below))
    assert np.array_equal(right + left, above + below)
    assert (right[1] > left[1]).all() and (above[0] < below[0]).all() and (right[0] == left[0]).all()


@pytest.mark.parametrize("mask", [np.ones((1, 1), bool), np.ones((2, 400), bool), np.zeros((30, 30), bool)])
def test_masks_without_room_have_no_sites(mask):
    assert sites(mask).shape == (4, 0) and wrong_axes(np.ones((4, 3, 0))) is None


def test_right_normals_fit():
    assert wrong_axes(at_sites(NORMAL)) is None


@pytest.mark.parametrize(("matrix", "undone"), [(np.diag([1, -1, 1]), np.diag([1, -1])), (np.diag([-1, 1, 1]), np.diag([1, -1])),
                                                (turn(90), turn(-90)[:2, :2]), (turn(137), turn(-137)[:2, :2]),
                                                (np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]]), np.array([[0, 1], [1, 0]]))])
def test_the_correction_is_found_up_to_half_a_turn(matrix, undone):
    found = wrong_axes(at_sites(matrix @ NORMAL))
    assert found is not None and found.left < 0.01 < found.misfit  # slopes are differences, not derivatives
    # the turn is the least squares solution, whose error is that of the differences
    assert min(np.abs(found.matrix - undone).max(), np.abs(found.matrix + undone).max()) < 0.02


@pytest.mark.parametrize("matrix", [np.diag([1, -1, 1]), np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]])])
def test_edges_between_planes_tell_axes(matrix):
    """A pyramid of eleven faces, whose normals have noise of 1.7°: all but some hundred of 2000 places lie within a face."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[1:-1:96j, -1:1:96j]
    ways = np.arange(11) * 2 * np.pi / 11
    face = np.argmax(np.cos(ways)[:, None, None] * x + np.sin(ways)[:, None, None] * y, axis=0)
    normal = np.stack([0.6 * np.cos(ways[face]), 0.6 * np.sin(ways[face]), np.ones_like(x)]).reshape(3, -1)
    normal = normal / np.linalg.norm(normal, axis=0) + 0.03 * rng.normal(size=normal.shape)
    whole = np.ones(x.shape, bool)
    assert wrong_axes(at_sites(normal, whole)) is None
    found = wrong_axes(at_sites(matrix @ normal, whole))
    assert min(np.abs(found.matrix - matrix[:2, :2]).max(), np.abs(found.matrix + matrix[:2, :2]).max()) < 0.02


def test_half_a_turn_cannot_be_seen():
    assert wrong_axes(at_sites(np.diag([-1, -1, 1]) @ NORMAL)) is None


def test_noise_alone_has_no_axes():
    rng = np.random.default_rng(0)
    noise = np.stack([0.1 * rng.normal(size=NORMAL.shape[1]), 0.1 * rng.normal(size=NORMAL.shape[1]), np.ones(NORMAL.shape[1])])
    assert wrong_axes(at_sites(noise)) is None


def test_a_round_paraboloid_mirrored_is_a_saddle_which_fits_as_well():
    """What docs/checks.md says cannot be seen."""
    x, y = np.meshgrid(np.linspace(-1, 1, 60), -np.linspace(-1, 1, 60))
    bowl = np.stack([-x, -y, np.ones_like(x)]).reshape(3, -1)
    assert wrong_axes(at_sites(bowl, np.ones((60, 60), bool))) is None
    assert wrong_axes(at_sites(np.diag([1, -1, 1]) @ bowl, np.ones((60, 60), bool))) is None


def test_few_lights_ask_for_more():
    """Noisy normals fit a mirroring better, but not well."""
    mirrored = at_sites(np.diag([1, -1, 1]) @ NORMAL)
    assert wrong_axes(mirrored, strict=True) is not None
    rng = np.random.default_rng(1)
    spoilt = mirrored + [[[0], [0], [0]]]
    spoilt[:, :2] += 0.1 * rng.normal(size=spoilt[:, :2].shape)
    found = wrong_axes(spoilt)
    assert found is not None and found.left > 0.1
    assert wrong_axes(spoilt, strict=True) is None


def test_few_sites_decide_nothing():
    normals = at_sites(np.diag([1, -1, 1]) @ NORMAL)
    assert wrong_axes(normals) is not None
    assert wrong_axes(normals[:, :, : LEAST_SITES - 1]) is None
