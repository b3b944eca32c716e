"""Defects are listed as large and as deep as they are, and noise that the σ does not know of, outliers and warp are none."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from service.boards.findings import find_defects
from service.boards.stitching.grid import BoardGrid, HeightMap
from service.boards.stitching.significance import compare, fit_form, scan_windows
from service.boards.tiles import without_spikes

GRID = BoardGrid(8e-5, 0.0, 0.01, 130, 150)
SIGMA = 4e-6
ROWS, COLS = slice(40, 91), slice(60, 102)
"""The chip: 42 x 51 pixels, 3.4 x 4.1 mm."""


def board(seed, *, chip=True, shared=0.0, outliers=0.0, warp=0.0):
    """A measured board with chips of vertical walls, blurred by optics; `shared` is the part of the noise that neighbours share."""
    rng = np.random.default_rng(seed)
    height = np.zeros((GRID.rows, GRID.cols))
    height[ROWS, COLS] = 7e-4 * chip
    height[15:30, 10:120], height[100:120, 20:50] = 4e-4, 1.1e-3
    height = gaussian_filter(height, 0.7)
    rough = gaussian_filter(rng.standard_normal((GRID.rows + 32, GRID.cols + 32)), 2.0)[16:-16, 16:-16]  # as strong at the borders
    noise = np.sqrt(1 - shared) * rng.standard_normal(height.shape) + np.sqrt(shared) * rough / rough.std()
    x, y = np.meshgrid(np.linspace(-1, 1, GRID.cols), np.linspace(-1, 1, GRID.rows))
    height = height + SIGMA * noise + warp * (x * y + 0.3 * x**3 - 0.2 * x * y * y)
    height = np.where(rng.random(height.shape) < outliers, height + rng.uniform(-1e-3, 1e-3, height.shape), height)
    told, sigma = without_spikes(height.ravel(), np.full(height.size, SIGMA), np.ones(height.shape, bool))
    return HeightMap(GRID, told.reshape(height.shape), sigma.reshape(height.shape) ** 2, np.zeros(height.shape))


def defects(measured, golden, *, shift_sigma_m=0.0):
    deviation = compare(measured, golden, shift_sigma_m=(shift_sigma_m, shift_sigma_m))
    deviation = deviation._replace(height=deviation.height - fit_form(GRID, deviation.height, quadratic=True).over(GRID))
    scan = scan_windows(deviation, tolerance_m=0.0, false_alarm=0.01, smallest_px=3)
    return find_defects(deviation, scan, np.zeros(deviation.height.shape))


def test_a_missing_chip_is_listed_as_large_and_deep_as_it_is():
    """Pixels at the walls are half as deep: the outline is known to a pixel, and the volume to that of a pixel's rim."""
    found, pixels = defects(board(1, chip=False, shared=0.5), board(2, shared=0.5))
    assert len(found) == 1
    area, chip = found[0].area, 51 * 42
    assert area.width_m == pytest.approx(42 * GRID.pixel_m, abs=2 * GRID.pixel_m)
    assert area.height_m == pytest.approx(51 * GRID.pixel_m, abs=2 * GRID.pixel_m)
    assert area.pixels == pixels.sum() == pytest.approx(chip, abs=2 * (51 + 42))
    assert found[0].deviation_m == pytest.approx(-7e-4, abs=5e-6) and found[0].peak_m == pytest.approx(-7e-4, abs=3 * SIGMA)
    assert found[0].volume_m3 == pytest.approx(area.area_m2 * found[0].deviation_m, rel=0.05)
    assert found[0].significance == pytest.approx(abs(found[0].deviation_m) / found[0].sigma_m)


@pytest.mark.parametrize("changes", [{}, {"shared": 0.6}, {"outliers": 0.01}, {"warp": 3e-5},
                                     {"shared": 0.4, "outliers": 0.004, "warp": 1e-5}], ids=["noise", "shared", "outliers", "warp", "all"])
def test_a_good_board_has_no_defect(changes):
    """Four boards: at 1 % false alarms, one in 25 sets of four would show one by chance."""
    golden = board(10, **changes)
    assert [defect for seed in range(4) for defect in defects(board(20 + seed, **changes), golden)[0]] == []


def test_a_small_defect_is_found_under_noise_that_neighbours_share():
    measured = board(30, shared=0.3)
    measured.height[70:74, 120:124] += 12 * SIGMA
    found, _ = defects(measured, board(31, shared=0.3))
    assert len(found) == 1 and found[0].area.pixels == pytest.approx(16, abs=4)


def test_a_narrow_chip_is_found_though_each_of_its_pixels_is_near_a_wall():
    """What may be misplaced there is shared by all, and is no noise that scatters more than the σ says."""
    golden, chip = board(40, shared=0.5, warp=1e-5), np.zeros((GRID.rows, GRID.cols))
    chip[60:90, 125:130] = 1.2e-3
    golden.height[...] += gaussian_filter(chip, 0.7)
    found, _ = defects(board(41, shared=0.5, warp=1e-5), golden, shift_sigma_m=4e-5)
    assert found[0].deviation_m == pytest.approx(-1.2e-3, rel=0.1) and found[0].area.pixels == pytest.approx(150, abs=35)
