"""Depths tested against each other: planes and steps pass, reversed order, lone depths and rays lit twice do not."""

import numpy as np
import pytest

from kernels.structured.opaque_surface import check_surface

ROWS, COLS, FOCAL = 60, 80, 100.0
X, Y = np.meshgrid((np.arange(COLS) + 0.5 - COLS / 2) / FOCAL, -(np.arange(ROWS) + 0.5 - ROWS / 2) / FOCAL)
BASELINE = 0.3
PROJECTOR = np.array([[1.0, 0, 0, -BASELINE], [0, -1, 0, 0], [0, 0, -1, 0]])
"""A projector 0.3 m to the right that looks along the camera's axis."""


def check(depth, device, *, sigma=1e-4, amplitude=None, solved=None):
    solved = np.ones(depth.shape, bool) if solved is None else solved
    light = np.ones(depth.shape) if amplitude is None else amplitude
    found = check_surface(depth.astype(np.float32), np.full(depth.shape, sigma, np.float32), light, solved, X, Y, PROJECTOR, device=device)
    return [array.numpy().reshape(depth.shape) for array in found]


@pytest.mark.parametrize("slope", [0.0, 1.5, -1.5])
def test_planes_raise_no_doubt(slope, device):
    turned, alone, contradicted, deviation = check(1.2 / (1 - slope * X), device)
    assert not turned.any() and not alone.any() and not contradicted.any() and (deviation == 0).all()


def test_a_step_raises_no_doubt(device):
    """What the projector's shadow hides on the far side is not solved."""
    depth = np.where(X > 0, 1.0, 1.4)
    reach = BASELINE - BASELINE * 1.4  # where the ray over the edge of the near side, at x = 0, meets the far one
    hidden = (X <= 0) & (depth * X > reach)
    turned, alone, contradicted, _ = check(depth, device, solved=~hidden)
    assert not turned.any() and not alone.any() and contradicted.mean() < 0.01


def test_reversed_order_faces_away(device):
    """A plane so steep that the camera sees one face and the projector the other: E = 2."""
    steep = (2 / BASELINE) * X + 1.0
    turned, *_ = check(1 / np.where(steep > 0.3, steep, 0.3), device, solved=steep > 0.3)
    inner = steep > 0.4
    inner[:, :2] = inner[:, -2:] = False
    assert turned[inner].mean() > 0.95


def test_noise_is_not_taken_for_reversed_order(device):
    rng = np.random.default_rng(2)
    turned, alone, *_ = check(1.2 + rng.normal(0, 0.02, X.shape), device, sigma=0.02)
    assert turned.mean() < 1e-3 and alone.mean() < 1e-3


def test_lone_depths_stand_alone(device):
    depth = np.full(X.shape, 1.2)
    depth[20, 30] = 0.7
    _, alone, *_ = check(depth, device)
    assert alone[20, 30] == 1 and alone.sum() == 1


def test_a_ray_that_ends_twice_is_contradicted(device):
    """Scattered ghosts between camera and wall, whose rays from the projector end at the wall; the wall is not doubted for them."""
    depth = np.full(X.shape, 1.5)
    ghost = np.zeros(X.shape, bool)
    ghost[20:40:4, 10:40:4] = True
    depth[ghost] = 0.9
    *_, contradicted, _ = check(depth, device)
    assert contradicted[ghost].mean() > 0.7 and contradicted[~ghost].mean() < 0.02


def test_texture_moves_the_light(device):
    """Closed form: with u = f (x - b s), a plane at 1.2 m and a shift of δ pixels the depth errs by Z δ / (f b s)."""
    amplitude = np.where(np.arange(COLS) % 40 < 20, 1.0, 1e-6) * np.ones(X.shape)
    *_, deviation = check(np.full(X.shape, 1.2), device, amplitude=amplitude)
    assert deviation[30, 20] == pytest.approx(1.2 * 0.125 / (FOCAL * BASELINE / 1.2), rel=0.01)
    assert deviation[30, 10] == 0
