"""Boards of another kind than those that the thresholds were chosen on: prints that differ, shared noise, outliers, holes."""

import numpy as np
import pytest

from benchmarks.printed_boards import ELSEWHERE_M, FAULTS, KINDS, Station
from service.boards.stitching.form import fit_form, fit_spline
from service.boards.stitching.grid import BoardGrid
from service.boards.stitching.regions import Verdict


@pytest.fixture(scope="module")
def station(tmp_path_factory) -> Station:
    return Station(tmp_path_factory.mktemp("boards"))


@pytest.mark.long
def test_good_prints_pass_with_missing_pixels_outliers_and_a_bent_board(station):
    """None of 66 of the benchmark is refused, so that six are not."""
    kind = KINDS[2]
    for seed in range(300, 306):
        result = station.inspect(kind.board(seed), seed, with_regions=True, **kind.options)
        assert result.verdict is Verdict.PASS and result.inspected > 0.999


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 18, 23, 45, 46])
def test_what_a_spline_leaves_and_outliers_side_by_side_are_no_defects(station, seed):
    """Each was, where the noise alone was taken to scatter more than its σ says, and five outliers that touch hid each other."""
    kind = KINDS[1]
    assert station.inspect(kind.board(seed), seed, with_regions=False, **kind.options).verdict is not Verdict.FAIL


@pytest.mark.long
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_prints_are_found(station, fault):
    for seed in range(400, 402):
        result = station.inspect(FAULTS[fault]._replace(warp=3e-6), seed, with_regions=True, tolerance_m=ELSEWHERE_M)
        assert result.verdict is Verdict.FAIL


def test_a_spline_takes_the_form_of_a_board_and_no_defect():
    """An S and holes in what is measured; a defect half as wide as the knots are apart stays to a hundredth."""
    grid = BoardGrid(1e-5, -1.5e-3, 1.08e-3, 216, 300)
    x, y = np.meshgrid(np.linspace(-1, 1, 300), np.linspace(1, -1, 216))
    warp = 5e-6 * np.sin(2 * np.pi * (0.5 * x + 0.07 * y))
    height = warp.copy()
    height[80:140, 100:180] = np.nan
    assert np.abs(fit_spline(grid, height, knots_m=7.5e-4).over(grid) - warp).max() < 0.1 * 5e-6
    assert np.abs(fit_form(grid, height, quadratic=True).over(grid) - warp).max() > 0.3 * 5e-6  # which a quadratic surface does not
    noise = 1e-6 * np.random.default_rng(1).standard_normal(warp.shape)
    defect = np.zeros(warp.shape)
    defect[100:137, 140:177] = 1e-5
    spline = fit_spline(grid, warp + noise + defect, knots_m=7.5e-4)
    error = spline.over(grid) - warp
    assert abs(error[100:137, 140:177].mean()) < 0.02 * 1e-5
    assert np.sqrt(np.mean((error / spline.sigma(grid)) ** 2)) < 2  # beside the noise of blocks, what the spline does not follow of the S
