"""A height for every pixel of the mask from that of the solved ones."""

import numpy as np
import pytest

from service.solve.height.height import whole_surface

ROWS, COLS = 20, 30
V, U = np.mgrid[:ROWS, :COLS]
SLOPE = 0.5 * U + 0.2 * V
FULL = np.ones((ROWS, COLS), dtype=bool)


def test_what_is_solved_keeps_its_shape_and_the_mask_gets_the_mean():
    solved = (U > 2) & (V < 15)
    out = whole_surface(SLOPE.astype(np.float32), solved, FULL, mean_z=7.0, perspective=False)
    assert out.dtype == np.float32 and out.mean() == pytest.approx(7, abs=1e-5)
    apart = (out - SLOPE)[solved]
    assert np.ptp(apart) < 1e-5
    rim = np.abs(out - SLOPE - apart.mean())[:15, :3]
    assert rim[:, 2].max() == pytest.approx(0.5, abs=1e-5)  # one pixel of slope, not extrapolated
    assert rim.max() == pytest.approx(1.5, abs=0.2)


def test_a_perspective_surface_is_scaled():
    depth = -5 - 0.01 * SLOPE
    out = whole_surface(depth.astype(np.float32), FULL, FULL, mean_z=-2.0, perspective=True)
    assert np.allclose(out / depth, -2.0 / depth.mean()) and out.mean() == pytest.approx(-2)


@pytest.mark.parametrize("perspective", [False, True])
def test_islands_go_where_the_mainland_reaches_them(perspective):
    """Unsolved pixels part a corner from the rest of the mask, so that its constant is not known."""
    surface = -40 - 0.1 * SLOPE
    solved = ~((U == 24) | (V == 15) & (U > 24))
    corner = (U > 24) & (V < 15)
    below = (U > 24) & (V > 15)
    loose = np.where(corner, surface * 1.3, np.where(below, surface * 0.8, surface)) if perspective else (
        surface + np.where(corner, 9, 0) - np.where(below, 4, 0))
    out = whole_surface(np.where(solved, loose, 0).astype(np.float32), solved, FULL, mean_z=-42.0, perspective=perspective)
    error = out / surface / (out / surface)[0, 0] * 40 - 40 if perspective else out - surface - (out - surface)[0, 0]
    assert np.abs(error)[solved & (U < 24)].max() < 1e-4
    assert np.abs(error)[corner | below].max() < 0.5  # two pixels of slope 0.1, and the rest of the way across: from 9 and 4


def test_parts_of_the_mask_that_do_not_touch_stay_where_they_are():
    mask = (U < 10) | (U > 20)
    height = np.where(U < 10, 1.0, 5.0) * mask
    out = whole_surface(height.astype(np.float32), mask, mask, mean_z=float(height[mask].mean()), perspective=False)
    assert np.allclose(out[mask], height[mask], atol=1e-6)
    assert ((out > 0.99) & (out < 5.01)).all()


def test_one_solved_pixel_and_a_large_gap():
    solved = np.zeros((600, 501), dtype=bool)
    solved[3, 4] = True
    height = np.where(solved, 3.0, np.nan).astype(np.float32)
    assert np.allclose(whole_surface(height, solved, np.ones_like(solved), mean_z=2.0, perspective=False), 2.0)
