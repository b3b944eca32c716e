"""Surfaces that break inside the mask."""

import numpy as np
import pytest
from scipy import ndimage

from tests.kernels.surface import shapes
from tests.kernels.surface.test_integrate import solve, worst
from tests.marks import first_short


def shape_error(height, truth, part):
    """Standard deviation of the error within one part: its shape, whatever its depth."""
    return (height - truth)[part].std()


def test_torn_sheet_is_found_up_to_its_tip(device):
    shape = shapes.torn_sheet(96)
    plain = worst(solve(shape, device), shape)
    assert plain > 0.3
    broken = solve(shape, device, discontinuities=True)
    assert worst(broken, shape) < 1e-3  # only the first pixels of the tear, less than 0.01 pixel open, hold together


def test_tear_is_found_under_noise(device):
    shape = shapes.torn_sheet(96)
    noise = np.random.default_rng(0).normal(0, 0.01, shape.normal.shape)
    noisy = shape._replace(normal=(shape.normal + noise).astype(np.float32))
    assert worst(solve(noisy, device, discontinuities=True), shape) < 0.01


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_smooth_surface_stays(noise, device):
    shape = shapes.bumps(128, shapes.ragged_mask(128, 128))
    normal = shape.normal + np.random.default_rng(0).normal(0, 1, shape.normal.shape) * noise
    shape = shape._replace(normal=normal.astype(np.float32))
    plain = solve(shape, device).height.numpy()
    broken = solve(shape, device, discontinuities=True).height.numpy()
    ours, theirs = ((h - shape.z)[shape.mask].std() for h in (broken, plain))
    assert ours < 1.1 * theirs


def parts_of(integration):
    """Sizes of the parts, largest first."""
    return np.sort(np.bincount(integration.part[integration.part >= 0]))[::-1]


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_tilted_disc_before_a_plane_keeps_both_slopes(noise, device):
    """Where the outline of the disc follows its axis of tilt no loop of slopes contradicts itself; the outline as a whole does.

    Noise of 0.03 leaves 0.03 / √pixels of a slope on each pixel's, and cuts few of the pixels that line the outline wrongly.
    """
    x, y = shapes.plane_coordinates(96, 96, size=2.4)
    disc = np.hypot(x, 1.16 * y) < 0.45
    shape = shapes.from_gradient(x, y, np.where(disc, 0.5 - 0.58 * y, 0), np.zeros_like(x), np.where(disc, -0.58, 0.0))
    shape = shape._replace(normal=(shape.normal + noise * np.random.default_rng(0).normal(size=shape.normal.shape)).astype(np.float32))
    found = solve(shape, device, discontinuities=True)
    assert found.converged and len(parts_of(found)) == 2
    for part, slope in ((disc, -0.58), (~disc, 0.0)):
        assert len(np.unique(found.part[part])) == 1
        up = np.polyfit(y[part], found.height.numpy()[part], 1)[0]
        assert up == pytest.approx(slope, abs=0.002 if noise else 1e-4)


@pytest.mark.parametrize(("degrees", "slope"), [(0, 0.5), (20, 1.0), (7, 2.0), (45, 0.5)])
def test_a_crease_is_no_break(degrees, slope, device):
    """A ridge at any angle to the pixels: the loops on its staircase contradict themselves, and its two sides meet all along it.

    The height errs by the ridge's place between two pixel centres, at most half a pixel times half of the turn.
    """
    x, y = shapes.plane_coordinates(96, 96, size=96)
    turn = np.radians(degrees)
    across = x * np.cos(turn) + y * np.sin(turn)
    shape = shapes.from_gradient(x, y, -slope * np.abs(across), *(-slope * np.sign(across) * side for side in (np.cos(turn), np.sin(turn))))
    found = solve(shape, device, discontinuities=True)
    assert len(parts_of(found)) == 1 and found.part_of.tolist() == [0, 0]
    sides = np.bincount(found.fragment[found.fragment >= 0], across[found.fragment >= 0] > 0)
    assert np.sort(sides / np.bincount(found.fragment[found.fragment >= 0])) == pytest.approx([0, 1], abs=0.05)
    assert worst(found, shape) * np.ptp(shape.z) < 0.5 * slope


def test_a_ball_before_a_wall_is_a_part_and_keeps_its_shape(device):
    shape, ball = shapes.ball_before_wall(192)
    plain, found = (solve(shape, device, discontinuities=each) for each in (False, True))
    for part in (ball, ~ball):
        assert shape_error(found.height.numpy(), shape.z, part) < 0.4 * shape_error(plain.height.numpy(), shape.z, part)
    assert parts_of(found).tolist() == [int((~ball).sum()), int(ball.sum())]
    assert len(np.unique(found.part[ball])) == 1


def test_an_outline_with_a_gap_parts_a_ball_from_a_wall(device):
    """In a strip two pixels wide the wall bends up to the ball by less than 8° a pixel, as wrong normals do. Through it, both were one."""
    shape, ball = shapes.ball_before_wall(192)
    normal, middle = shape.normal.copy(), 96
    end = np.flatnonzero(ball[middle])[-1]
    turns = np.arccos(normal[2, middle, end]) * np.linspace(1, 0, 20)
    normal[:, middle - 1 : middle + 1, end + 1 : end + 21] = np.stack([np.sin(turns), 0 * turns, np.cos(turns)])[:, None]
    found = solve(shape._replace(normal=normal), device, discontinuities=True)
    assert len(parts_of(found)) == 2
    assert np.mean(found.part[ball] == np.median(found.part[ball])) > 0.99 and parts_of(found)[1] < 1.02 * ball.sum()


def test_a_strip_along_an_outline_is_no_part(device):
    """Two pixels on either side of the outline of a ball show both sides: the ring was a part of its own of 536 pixels."""
    shape, ball = shapes.ball_before_wall(96)
    strip = ndimage.binary_dilation(ball, iterations=2) & ~ndimage.binary_erosion(ball, iterations=2)
    around = np.arctan2(*(np.indices(ball.shape) - 47.5))
    normal = shape.normal.copy()
    normal[:, strip] = (np.stack([0.6 * np.cos(around), -0.6 * np.sin(around), np.ones_like(around)]) / np.hypot(0.6, 1))[:, strip]
    found = solve(shape._replace(normal=normal.astype(np.float32)), device, discontinuities=True)
    assert len(parts_of(found)) == 2 and len(np.unique(found.part[ball & ~strip])) == 1


def test_an_outline_that_meets_what_is_behind_along_one_half_is_that_of_a_part(device):
    """A dome before two plates, one of which follows its outline at a constant step: the dome was joined to this one."""
    x, y = shapes.plane_coordinates(96, 96, size=2.4)
    dome, right = np.hypot(x, y) < 0.45, x >= 0
    z = np.where(dome, 1.0 - 0.7 * (x**2 + y**2), np.where(right, 0.58 * y, 0))
    slopes = np.where(dome, -1.4 * x, 0), np.where(dome, -1.4 * y, np.where(right, 0.58, 0))
    found = solve(shapes.from_gradient(x, y, z, *slopes), device, discontinuities=True)
    assert parts_of(found).tolist() == sorted((int((~dome & right).sum()), int((~dome & ~right).sum()), int(dome.sum())), reverse=True)


@first_short("perspective", [False, True])
def test_the_size_of_bands_changes_nothing(perspective, device, monkeypatch):
    """Bands of two rows and pieces of some cells, against the whole surface at one time."""
    shape, _ = shapes.ball_before_wall(96)
    noise = np.random.default_rng(0)
    shape = shape._replace(normal=(shape.normal + noise.normal(0, 0.03, shape.normal.shape)).astype(np.float32))
    sigma = noise.uniform(0, 20, shape.mask.shape).astype(np.float16)
    options = {"perspective": perspective, "mean_z": -3.0, "sigma": sigma, "discontinuities": True}
    whole = solve(shape, device, **options)
    monkeypatch.setattr("kernels.surface.normal_map.BAND_PIXELS", 2 * 96)
    monkeypatch.setattr("kernels.surface.fragments.CELLS_AT_ONCE", 1000)
    banded = solve(shape, device, **options)
    np.testing.assert_array_equal(banded.height.numpy(), whole.height.numpy())
    np.testing.assert_array_equal(banded.part, whole.part)
    assert len(parts_of(whole)) > 1


def test_another_material_behind_an_edge_is_a_part_of_its_own(device):
    """A coin with a bevel of 45° on a board meets it all along its outline; of another material, it may lie on it or stand before it.

    It stays where it meets the board in the mean. Tolerance: half a pixel in each of the two directions of a turn of 45°.
    """
    x, y = shapes.plane_coordinates(128, 128, size=128)
    radius = np.hypot(x, y)
    bevel = (radius > 24) & (radius < 32)
    shape = shapes.from_gradient(x, y, np.clip(32 - radius, 0, 8), *(np.where(bevel, -side / np.maximum(radius, 1), 0) for side in (x, y)))
    assert len(parts_of(solve(shape, device, discontinuities=True))) == 1
    found = solve(shape, device, discontinuities=True, kind=radius < 32)
    assert parts_of(found).tolist() == [(radius >= 32).sum(), (radius < 32).sum()]
    assert worst(found, shape) * np.ptp(shape.z) < 1


@first_short("noise", [0.0, 0.02])
def test_an_inlay_goes_on_as_the_surface_does(noise, device):
    """Dots, stripes and a half of another material on a cap, which turns by 70° up to its rim. Tolerance: single precision."""
    shape = shapes.cap(128)
    shape = shape._replace(normal=(shape.normal + noise * np.random.default_rng(0).normal(size=shape.normal.shape)).astype(np.float32))
    row, col = np.indices(shape.mask.shape)
    plain = solve(shape, device, discontinuities=True)
    for kind in (np.hypot(row % 26 - 13, col % 26 - 13) < 6, row % 32 < 11, col > 70):
        found = solve(shape, device, discontinuities=True, kind=kind)
        assert len(parts_of(found)) == len(parts_of(plain)) == 1
        np.testing.assert_allclose(found.height.numpy(), plain.height.numpy(), atol=1e-5 + 1e-3 * noise)
