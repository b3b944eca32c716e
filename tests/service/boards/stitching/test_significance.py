"""The statistics of inspection: false alarms as often as stated, shared errors that do not average out, verdicts by σ."""

import numpy as np
import pytest

from service.boards.stitching.form import bow_and_twist, fit_form
from service.boards.stitching.grid import BoardGrid, HeightMap
from service.boards.stitching.regions import Verdict, check_regions
from service.boards.stitching.significance import compare, mean_of, scan_windows, threshold
from stage.sets.board import Region

GRID = BoardGrid(1e-5, 0.0, 1e-3, 100, 120)
SIGMA = 1e-6


def noise(seed: int = 0, *, shared: float = 0.0, sigma: float = SIGMA) -> HeightMap:
    shape = (GRID.rows, GRID.cols)
    return HeightMap(GRID, sigma * np.random.default_rng(seed).standard_normal(shape), np.full(shape, SIGMA**2), np.full(shape, shared))


def test_thresholds_are_those_of_the_normal_distribution():
    """Tabulated quantiles: 1.960 at 5 % on two sides, 4.417 at 5 % over 10 000 tests on one side."""
    assert threshold(0.05, 1) == pytest.approx(1.95996, abs=1e-4)
    assert threshold(0.05, 10_000, sides=1) == pytest.approx(4.41717, abs=1e-4)


@pytest.mark.long
def test_noise_alone_gives_no_more_false_alarms_than_stated():
    """60 boards at 20 %: the bound allows 12 ± 3; overlapping windows give fewer."""
    alarms = sum(scan_windows(noise(seed), tolerance_m=0.0, false_alarm=0.2, smallest_px=2).significant.any() for seed in range(60))
    assert 1 <= alarms <= 19  # 12 + 2.3 σ; none at all would mean that the threshold is far too high


@pytest.mark.parametrize(("side", "height"), [(3, 5.0), (6, 2.0), (24, 0.6)])
def test_a_defect_is_found_where_it_is(side, height):
    """Means over the defect are 15, 12 and 14.4 σ, the threshold is near 5.5."""
    deviation = noise(3)
    deviation.height[40 : 40 + side, 50 : 50 + side] += height * SIGMA
    scan = scan_windows(deviation, tolerance_m=0.0, false_alarm=0.01, smallest_px=3)
    rows, cols = np.nonzero(scan.significant)
    assert rows.size >= side * side / 2
    assert 40 - side <= rows.min() and rows.max() < 40 + 2 * side and 50 - side <= cols.min() and cols.max() < 50 + 2 * side


def test_a_spike_of_one_pixel_is_no_defect_of_three():
    deviation = noise(4)
    deviation.height[30, 30] = 1e-3
    assert not scan_windows(deviation, tolerance_m=0.0, false_alarm=0.01, smallest_px=3).significant.any()


def test_errors_that_neighbours_share_do_not_average_out():
    deviation = noise(5, shared=0.5 * SIGMA)
    found = mean_of(deviation, np.ones((GRID.rows, GRID.cols), dtype=bool))
    assert found is not None and found.sigma == pytest.approx(0.5 * SIGMA, rel=0.01)
    alone = mean_of(noise(5), np.ones((GRID.rows, GRID.cols), dtype=bool))
    assert alone is not None and alone.sigma == pytest.approx(SIGMA / np.sqrt(GRID.rows * GRID.cols), rel=1e-6)


def region(**changes) -> Region:
    return Region(**{"name": "pad", "shape": "rectangle", "centre_m": (6e-4, 5e-4), "size_m": (1e-4, 1e-4), "tolerance_m": (-2e-6, 2e-6),
                     **changes})


@pytest.mark.parametrize(("offset", "shared", "verdict"), [
    (0.0, 0.0, Verdict.PASS), (4.0, 0.0, Verdict.FAIL), (-4.0, 0.0, Verdict.FAIL), (2.0, 0.0, Verdict.UNDECIDED),
    (0.0, 1.0, Verdict.UNDECIDED), (4.0, 1.0, Verdict.UNDECIDED),
])
def test_a_region_passes_or_fails_by_more_than_its_uncertainty(offset, shared, verdict):
    """The mean of 100 pixels has 0.1 σ of noise, k is 2.8: ± 0.28 µm around ± 2 µm; a shared error of 1 µm leaves nothing decided."""
    deviation = noise(6, shared=shared * SIGMA)
    moved = deviation._replace(height=deviation.height + offset * SIGMA)
    results, k = check_regions(moved, [region()], false_alarm=0.005, least_inspected=0.9)
    assert results[0].verdict is verdict
    assert k == pytest.approx(threshold(0.005, 2, sides=1))


def test_a_region_that_is_not_measured_never_passes():
    deviation = noise(7)
    deviation.height[45:55, 55:60] = np.nan
    assert check_regions(deviation, [region()], false_alarm=0.005, least_inspected=0.9)[0][0].verdict is Verdict.NOT_INSPECTED
    deviation.height[:] = np.nan
    assert check_regions(deviation, [region()], false_alarm=0.005, least_inspected=0.9)[0][0].verdict is Verdict.NOT_INSPECTED


def test_a_region_may_count_from_what_surrounds_it():
    """A board that is 5 µm high there passes with the datum around it, and fails with that of the whole board."""
    deviation = noise(8)
    deviation.height[30:70, 40:80] += 5e-6
    assert check_regions(deviation, [region()], false_alarm=0.005, least_inspected=0.9)[0][0].verdict is Verdict.FAIL
    assert check_regions(deviation, [region(datum="surround")], false_alarm=0.005, least_inspected=0.9)[0][0].verdict is Verdict.PASS


def test_circles_hold_the_pixels_of_a_circle():
    """A disc of 40 pixels across has π/4 · 1600 pixels; their count is exact to the pixels that its outline cuts."""
    results, _ = check_regions(noise(9), [region(shape="circle", size_m=(4e-4, 4e-4))], false_alarm=0.005, least_inspected=0.9)
    assert results[0].pixels == pytest.approx(np.pi * 400, rel=0.02)


def test_forms_are_found_beside_defects():
    """A plane and a bow under a step over an eighth of the board."""
    y, x = np.mgrid[1:-1:100j, -1:1:120j]
    height = 3e-6 * x - 2e-6 * y + 1e-6 + 4e-5 * ((x > 0.2) & (y > 0.4) & (x < 0.8))
    plane = fit_form(GRID, height, quadratic=False)
    assert plane.coefficients == pytest.approx([1e-6, 3e-6, -2e-6], abs=1e-7)  # x and y of the mgrid reach ± 1, those of pixels not quite
    bow = fit_form(GRID, height + 1e-5 * x * x, quadratic=True)
    assert bow.coefficients[3] == pytest.approx(1e-5, rel=0.05)
    assert bow_and_twist(bow, GRID) == pytest.approx(2 / 3 * 1e-5, rel=0.1)  # 1 − mean of x²


def test_edges_have_an_error_that_neighbours_share():
    """Maps whose step lies half a pixel apart differ by half of it along the edge, and not significantly."""
    col = np.arange(GRID.cols)
    steps = [1e-4 * np.clip(col - 60.5 + away, 0, 1) * np.ones((GRID.rows, 1)) for away in (0.0, 0.5)]
    rng = np.random.default_rng(1)
    maps = [HeightMap(GRID, step + SIGMA * rng.standard_normal(step.shape), np.full(step.shape, SIGMA**2), np.zeros(step.shape))
            for step in steps]
    deviation = compare(*maps, shift_sigma_m=(0.0, 0.0))
    assert np.abs(deviation.height[:, 59:63]).max() > 40 * SIGMA
    assert not scan_windows(deviation, tolerance_m=0.0, false_alarm=0.01, smallest_px=3).significant.any()
    assert np.median(deviation.sigma) == pytest.approx(np.sqrt(2) * SIGMA)
