"""Tiles of simulated boards come together: where they lie, how exact the blend is, and what is refused with a sentence."""

import numpy as np
import pytest

from service.boards.stitching.grid import BLOCK_PX, blocks_of, robust_sigma
from service.boards.stitching.stitching import TilePoints, blend, stitch
from stage.errors import BoardError
from tests.marks import first_short
from tests.scenes.board import PIXEL, SIGMA, View, components, domes, scan

SIDE, STEP = (120, 130), (1.0e-3, 0.9e-3)
"""Tiles of 1.3 x 1.2 mm that overlap by 30 pixels."""


def points(views: list[View], *, sigma: float = SIGMA) -> list[TilePoints]:
    """The tiles as service.boards takes them, at the pose that the stage tells."""
    out = []
    for number, view in enumerate(views):
        rows, cols = view.height.shape
        x, y = np.meshgrid((np.arange(cols) + 0.5 - cols / 2) * PIXEL, (rows / 2 - np.arange(rows) - 0.5) * PIXEL)
        there = np.isfinite(view.height)
        out.append(TilePoints(f"t{number}", *(values[there].astype(np.float32) for values in (x, y, view.height)),
                              np.full(int(there.sum()), sigma, np.float32), np.array([*view.told, 0.0]), PIXEL, there))
    return out


def views_of(surface, *, across: int = 2, down: int = 2, seed: int = 1, **options) -> list[View]:
    return scan(surface, across=across, down=down, side=SIDE, step=STEP, seed=seed, **options)


def errors(surface, views: list[View], stitched, heights) -> np.ndarray:
    """[rows, cols] metres: the blend less the truth, less the place and plane of the whole board, which tiles cannot tell."""
    grid = heights.grid
    x, y = grid.coordinates(*np.mgrid[: grid.rows, : grid.cols])
    own, true = stitched.motions.values, np.array([view.true for view in views])
    turn = np.median(own[:, 2] / stitched.length_m - true[:, 2])
    told = np.array([view.told for view in views])
    away = own[:, :2] + (own[:, 2:3] / stitched.length_m) * np.stack([-told[:, 1], told[:, 0]], 1) - true[:, :2]
    dx, dy = np.median(away - turn * np.stack([-told[:, 1], told[:, 0]], 1), axis=0)
    found = heights.height - surface(x - dx + turn * y, y - dy - turn * x)
    there = np.isfinite(found)
    basis = np.stack([np.ones(there.sum()), x[there], y[there]], axis=1)
    found[there] -= basis @ np.linalg.lstsq(basis, found[there], rcond=None)[0]
    return found


@first_short(("surface", "options"), [
    (domes(4e-3, 4e-3), {"turn": 3e-4, "stage": 3e-5}),
    (domes(4e-3, 4e-3, jitter=0.0), {}),
    (domes(4e-3, 4e-3, seed=5, bow=2e-4), {"missing": 0.1}),
    (domes(4e-3, 4e-3, seed=6, pitch=6e-4), {"tilt": 5e-3, "offset": 1e-4}),
], ids=["turned", "periodic", "warped, a tenth missing", "tilted"])
def test_the_error_of_stitching_is_below_the_noise_of_a_tile(surface, options):
    """Blocks of 16 x 16 pixels have a noise of σ / 16 = 0.06 σ; what offsets and tilts of tiles leave comes to it."""
    views = views_of(surface, **options)
    stitched = stitch(points(views), shift_sigma_m=options.get("stage", 1.5e-5))
    heights = blend(points(views), stitched, stitched.grid)
    left = errors(surface, views, stitched, heights)
    there = np.isfinite(left)
    assert robust_sigma(left[there]) < 0.8 * SIGMA  # gridding and overlaps average
    means = blocks_of(left).mean(axis=(2, 3))
    means = means[np.isfinite(means)]
    assert robust_sigma(means) < 0.25 * SIGMA
    shift = stitched.motions.values[:, :2] - np.array([view.true[:2] for view in views])
    if not options.get("turn"):
        assert np.ptp(shift, axis=0).max() < 0.15 * PIXEL  # a tenth of a pixel on slopes of 1 is 1 µm
    assert stitched.noise_factor == pytest.approx(1.0, abs=0.1)
    assert np.median(heights.sigma[there]) == pytest.approx(SIGMA, rel=0.15)  # single tiles cover most


def test_sums_over_blocks_have_the_noise_that_the_map_says():
    """Gridding spreads the noise of a point over pixels; `variance` is what sums need, checked on a flat board of one tile."""
    view = views_of(lambda x, y: 0 * x, across=1, down=1, tilt=0, offset=0, seed=3)[0]
    means, shares = [], []
    for k in range(6):  # the error depends on where points lie between pixels
        rng = np.random.default_rng(k)
        moved = view._replace(told=tuple(rng.uniform(0, PIXEL, 2)), height=SIGMA * rng.standard_normal(view.height.shape))
        tile = points([moved])
        stitched = stitch(tile)
        stitched = stitched._replace(grid=stitched.grid._replace(left_m=-8e-4, top_m=8e-4))
        heights = blend(tile, stitched, stitched.grid)
        blocks = blocks_of(heights.height[20:-20, 20:-20]).mean(axis=(2, 3))
        means.append(blocks[np.isfinite(blocks)] * BLOCK_PX / np.sqrt(np.nanmedian(heights.variance)))
        shares.append(np.nanstd(heights.height[40:-40, 40:-40]) / SIGMA)
    assert np.concatenate(means).std() == pytest.approx(1.0, abs=0.15)  # 200 blocks: 5 %, their borders less
    assert min(shares) < 0.75  # single pixels have less noise than σ says


def test_flat_tiles_lie_where_the_stage_says():
    views = views_of(lambda x, y: 0 * x)
    stitched = stitch(points(views))
    assert np.abs(stitched.motions.values[:, :2]).max() < 1e-9
    assert any("too little relief" in sentence for sentence in stitched.warnings)
    left = errors(lambda x, y: 0 * x, views, stitched, blend(points(views), stitched, stitched.grid))
    means = blocks_of(left).mean(axis=(2, 3))
    assert np.nanstd(means) < 0.25 * SIGMA  # offsets, 20 σ from tile to tile, are found all the same
    assert np.ptp([view.true[3] for view in views]) > 20 * SIGMA


def test_pads_of_one_pitch_are_not_aliased_quietly():
    surface = domes(4e-3, 4e-3, jitter=0.0)
    with pytest.raises(BoardError, match=r"tiles t\d and t\d: shifts that differ by 0\.000[3-9]\S* m"):
        stitch(points(views_of(surface, stage=1.5e-4, seed=4)), shift_sigma_m=1.5e-4)


@pytest.mark.long
def test_one_place_that_does_not_repeat_settles_pads_of_one_pitch():
    """A taller dome in every overlap but one; the loop of the others tells where the last pair belongs."""
    pads = domes(4e-3, 4e-3, jitter=0.0)

    def surface(x, y):
        return pads(x, y) + 4e-5 * sum((np.hypot(x - a, y - b) < 1.2e-4) for a, b in ((0, 4e-4), (-4.5e-4, 0), (5e-4, 0)))

    views = views_of(surface, stage=1e-4, seed=4)
    stitched = stitch(points(views), shift_sigma_m=1e-4)
    shift = stitched.motions.values[:, :2] - np.array([view.true[:2] for view in views])
    assert np.ptp(shift, axis=0).max() < 0.2 * PIXEL


@pytest.mark.long
@pytest.mark.parametrize(("change", "words"), [
    (lambda views: [v if k != 3 else v._replace(height=v.height[:, ::-1]) for k, v in enumerate(views)], "tile t3: is mirrored"),
    (lambda views: [v._replace(told=(v.told[0] * 1e3, v.told[1] * 1e3)) for v in views],
     "tile t0: overlaps no other tile: .* these look like"),
    (lambda views: [v if k != 2 else v._replace(told=(0.4, 0.0)) for k, v in enumerate(views)], "tile t2: overlaps no other tile"),
    (lambda views: [*views[:3], views_of(domes(4e-3, 4e-3, seed=8))[3]],
     "tiles t[12] and t3: do not show the same surface where they"),
], ids=["mirrored", "millimetres", "far away", "another board"])
def test_tiles_that_do_not_fit_are_one_sentence(change, words):
    views = views_of(domes(4e-3, 4e-3, seed=2))
    with pytest.raises(BoardError, match=words):
        stitch(points(change(views)))


@pytest.mark.long
def test_a_tile_far_from_where_the_stage_says_is_found_and_told():
    """35 pixels away, where the stage is said to be exact to 5: all overlaps agree about it, so that it is used, with a warning."""
    views = views_of(domes(4e-3, 4e-3, seed=2))
    views[1] = views[1]._replace(told=(views[1].told[0] - 3.1e-4, views[1].told[1] + 1.7e-4))
    stitched = stitch(points(views))
    shift = stitched.motions.values[:, :2] - np.array([view.true[:2] for view in views])
    assert np.ptp(shift, axis=0) == pytest.approx([3.1e-4, 1.7e-4], abs=0.3 * PIXEL)
    assert any("tile t1 lies" in sentence and "from where the stage says" in sentence for sentence in stitched.warnings)


@pytest.mark.long
def test_along_a_straight_edge_no_shift_is_measured():
    """The aperture problem: a step across all tiles measures their shift across it, and along it they lie where the stage says."""
    views = views_of(lambda x, y: 5e-5 / (1 + np.exp(-(y - 0.3 * x) / 1.5e-5)), stage=PIXEL)
    stitched = stitch(points(views))
    across = np.array([-0.3, 1.0]) / np.hypot(0.3, 1.0)
    shift = stitched.motions.values[:, :2] - np.array([view.true[:2] for view in views])
    pair = (shift[0] - shift[1]) @ across  # the step crosses the overlap of tiles 0 and 1, or of 2 and 3
    other = (shift[2] - shift[3]) @ across
    assert min(abs(pair), abs(other)) < 0.1 * PIXEL
    for tile in range(len(views)):
        sigma = np.sqrt(np.linalg.eigvalsh(stitched.motions.of_tile(tile)[:2, :2])[-1])
        assert sigma > 2 * PIXEL  # along the step the stage's 5 pixels remain


def places_off(views: list[View], stitched) -> tuple[np.ndarray, np.ndarray]:
    """[tiles, 2] pixels: by how much each tile lies off, but for the place and turn of the whole board, and its stated σ."""
    told = np.array([view.told for view in views]) - np.array(stitched.centre)
    turned = np.stack([-told[:, 1], told[:, 0]], axis=1)
    own, length = stitched.motions.values, stitched.length_m
    off = own[:, :2] + own[:, 2:3] / length * turned - np.array([view.true[:2] for view in views])
    whole = np.zeros((off.size, 3))
    whole[0::2, 0], whole[1::2, 1], whole[:, 2] = 1, 1, turned.ravel()
    left = off.ravel() - whole @ np.linalg.lstsq(whole, off.ravel(), rcond=None)[0]
    sigma = [np.sqrt(np.diag(rows @ stitched.motions.of_tile(number) @ rows.T)) for number, (x, y) in enumerate(told / length)
             for rows in [np.array([[1, 0, -y, 0, 0, 0], [0, 1, x, 0, 0, 0]])]]
    return left.reshape(-1, 2) / PIXEL, np.array(sigma) / PIXEL


@pytest.mark.long
def test_vertical_walls_place_tiles_to_a_part_of_a_pixel_and_sigma_says_it():
    """A wall between two points may be anywhere between them, along all of its straight part. Before its error counted, half of the tiles
    lay 8 σ off and more; the bounds leave half as much again as 40 such boards have (median .66, 95th percentile 3)."""
    over = []
    for seed in range(10, 20):
        views = views_of(components(2.4e-3, 2.2e-3, seed=seed, count=12), seed=100 + seed)
        off, sigma = places_off(views, stitch(points(views), shift_sigma_m=2 * PIXEL))
        over.append(np.abs(off) / sigma)
    assert np.median(over) < 1 and np.percentile(over, 95) < 4.5


@pytest.mark.long
def test_a_tile_that_is_noisier_than_the_others_is_named_and_has_a_wider_sigma():
    """Noise of three σ; overlaps tell it to a tenth."""
    views = views_of(domes(4e-3, 4e-3), across=3)
    rng = np.random.default_rng(5)
    views[1] = views[1]._replace(height=views[1].height + np.sqrt(8) * SIGMA * rng.standard_normal(SIDE))
    stitched = stitch(points(views), shift_sigma_m=1.5e-5)
    assert stitched.tile_noise[1] == pytest.approx(3, rel=0.1) and stitched.noise_factor < 1.1
    assert max(np.delete(stitched.tile_noise, 1)) < 1.2
    assert [sentence for sentence in stitched.warnings if "tile t1 is" in sentence]
    even = stitch(points(views, sigma=SIGMA / 2), shift_sigma_m=1.5e-5)
    assert even.noise_factor == pytest.approx(2, rel=0.1) and even.tile_noise[1] == pytest.approx(6, rel=0.12)
