"""What the deviations of a whole board share is told with its size, and no right board is accused of it."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from service.boards.shared_deviation import shared_deviation
from service.boards.stitching.grid import BoardGrid, HeightMap
from tests.scenes.board import PIXEL, SIGMA, components, domes, scan, write_scan
from tests.scenes.printed_board import COLS, ROWS, Print, measured, surface
from tests.scenes.printed_board import PIXEL as PRINT_PIXEL
from tests.scenes.printed_board import SIGMA as PRINT_SIGMA

GRID = BoardGrid(PIXEL, -1.2e-3, 1e-3, 200, 240)
STATION = {"across": 2, "down": 2, "side": (120, 130), "step": (1.0e-3, 0.9e-3)}


def seen(heights, seed: int, *, high: float = 1.0, large: float = 1.0, blur: float = 0.0) -> HeightMap:
    """A board as a sensor sees it that makes it so high, so large and so unsharp (σ, pixels), with the noise of `tests.scenes.board`."""
    x, y = GRID.coordinates(*np.mgrid[: GRID.rows, : GRID.cols])
    height = high * heights(x / large, y / large)
    height = gaussian_filter(height, blur) if blur else height
    height = height + SIGMA * np.random.default_rng(seed).standard_normal(height.shape)
    return HeightMap(GRID, height, np.full(height.shape, SIGMA**2), np.zeros(height.shape))


def deviation_of(board: HeightMap, nominal: HeightMap) -> HeightMap:
    return HeightMap(board.grid, board.height - nominal.height, board.variance + nominal.variance, np.zeros(board.height.shape))


@pytest.mark.parametrize(("fault", "name", "value", "tolerance"), [
    ({"high": 1.03}, "height_factor", 1.03, 0.002), ({"large": 1.004}, "size_factor", 1.004, 0.0003),
    ({"blur": 1.2}, "blur_px2", 1.44, 0.3)], ids=lambda value: value if isinstance(value, str) else "")
def test_what_a_whole_board_deviates_by_is_told_with_its_size(fault, name, value, tolerance):
    """Tolerances: of the height and the size 5 % and 8 % of the fault, of the blur, whose higher terms count, 20 %."""
    heights = domes(2.4e-3, 2.0e-3, seed=3)
    nominal = seen(heights, 1)
    found = shared_deviation(deviation_of(seen(heights, 2, **fault), nominal), nominal)
    assert found is not None
    named = found.named()
    assert [key for key, factor in named.items() if factor.clear] == [name]
    assert named[name].value == pytest.approx(value, abs=tolerance)
    assert len(found.sentences()) == 1


@pytest.mark.long
def test_prints_whose_pads_differ_share_nothing():
    """Thirty prints whose pads are 3 % thicker or thinner each."""
    grid = BoardGrid(PRINT_PIXEL, -COLS / 2 * PRINT_PIXEL, ROWS / 2 * PRINT_PIXEL, ROWS, COLS)

    def printed(what: Print, seed: int) -> HeightMap:
        rng = np.random.default_rng(seed)
        height = measured(surface(what, rng), rng, outliers=0.0)
        there = np.where(np.isfinite(height), 1.0, np.nan)
        return HeightMap(grid, height, PRINT_SIGMA**2 * there, 0 * there)

    nominal = printed(Print(), 999)
    found = [shared_deviation(deviation_of(printed(Print(spread=0.03, texture=2e-6), seed), nominal), nominal) for seed in range(30)]
    assert [each for each in found if each is None or each.sentences()] == []


def inspected(relit, folder, views: list, *, sigma: float = SIGMA) -> dict:
    """Inspect a board against one that was measured before; its report."""
    for name, each, more in (("golden", views[0], []), ("board", views[1], ["--golden", folder / "golden" / "out"])):
        write_scan(folder / name, each, stage_sigma_m=2 * PIXEL, sigma=sigma)
        relit("inspect-board", folder / name, *more, "--out", folder / name / "out", "--device", "cpu")
    return json.loads((folder / "board" / "out" / "report.json").read_text())


@pytest.mark.long
@pytest.mark.parametrize("seed", [7, 55])
def test_a_good_board_of_vertical_walls_has_no_defect(relit, tmp_path, seed):
    """Tiles that walls alone place, of which 13 in 18 such boards had defects beside them."""
    walls = components(2.4e-3, 2.2e-3, seed=seed, count=16)
    assert inspected(relit, tmp_path, [scan(walls, **STATION, seed=seed + k) for k in (0, 1)])["defects"] == []


@pytest.mark.long
def test_a_good_board_has_no_defect_where_noise_hides_its_slopes(relit, tmp_path):
    """Domes of 60 µm under noise of 10: tiles lie where the stage says, to 2 pixels, and slopes below the noise of a pixel count."""
    bumps = domes(2.4e-3, 2.2e-3, seed=4)
    found = inspected(relit, tmp_path, [scan(bumps, **STATION, seed=k, sigma=10 * SIGMA) for k in (1, 2)], sigma=10 * SIGMA)
    assert found["defects"] == []
    assert found["comparison"]["shared"]["height_factor"]["value"] == pytest.approx(1, abs=0.1)


@pytest.mark.long
def test_a_depth_that_is_scaled_is_said_beside_its_defects(relit, tmp_path):
    bumps = domes(2.4e-3, 2.2e-3, seed=4)
    views = [scan(bumps, **STATION, seed=k) for k in (1, 2)]
    found = inspected(relit, tmp_path, [views[0], [view._replace(height=1.04 * view.height) for view in views[1]]])
    shared = found["comparison"]["shared"]["height_factor"]
    assert shared["value"] == pytest.approx(1.04, abs=0.004) and shared["sigma"] < 0.008
    assert found["defects"] and any("1.04" in said or "1.039" in said or "1.038" in said for said in found["warnings"])
