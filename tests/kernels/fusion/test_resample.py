"""Range images from points: planes and balls in closed form, two surfaces, holes, and an independent fit in double precision."""

import numpy as np
import pytest

from kernels.fusion.resample import EXPLAINED, LEAST_FREE, NEAREST, REACH, WIDTH, resample

ROWS, COLS, FOCAL = 40, 50, 400.0
SIGMA = 2e-4


def scattered(seed: int, per_pixel: float = 1.0) -> np.ndarray:
    """Places that are uniform in the image and a little beyond."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-3, -3), (COLS + 3, ROWS + 3), (round(per_pixel * (ROWS + 6) * (COLS + 6)), 2))


def plane(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Depth of a plane that leans by some 60°."""
    return 1 / (0.5 + 0.002 * (u - COLS / 2) - 0.001 * (v - ROWS / 2))


def centres() -> tuple[np.ndarray, np.ndarray]:
    return np.meshgrid(np.arange(COLS) + 0.5, np.arange(ROWS) + 0.5)


def test_a_plane_is_exact(device):
    places = scattered(1)
    found = resample(places, plane(*places.T), np.full(len(places), SIGMA), (ROWS, COLS), FOCAL, device=device)
    known = found.nearest >= 0
    assert known[1:-1, 1:-1].mean() > 0.995 and ((found.depth > 0) == known).all() and ((found.sigma > 0) == known).all()
    # 24 bits of a coordinate of 50 pixels, times the slope, and of the sums
    assert np.abs(found.depth - plane(*centres()))[known].max() < 2e-6 * 2
    near = np.hypot(*(places[found.nearest[known]] - np.stack(centres(), axis=-1)[known]).T)
    assert near.max() <= NEAREST + 1e-5


def test_the_errors_are_what_sigma_says(device):
    places = scattered(2)
    truth = plane(*places.T)
    sigma = np.where(places[:, 0] < COLS / 2, SIGMA, 3 * SIGMA)
    noisy = truth + sigma * np.random.default_rng(3).standard_normal(len(places))
    found = resample(places, noisy, sigma, (ROWS, COLS), FOCAL, device=device)
    known = found.nearest >= 0
    ratio = ((found.depth - plane(*centres())) / np.where(known, found.sigma, 1))[known]
    # some 300 independent groups of pixels: their RMS is 1 with a standard deviation of .04
    assert np.sqrt((ratio**2).mean()) == pytest.approx(1, abs=0.16) and abs(ratio.mean()) < 0.25
    # less sure than the nearest point alone is only what leaves more than EXPLAINED by chance
    assert (found.sigma[known] <= sigma[found.nearest[known]] * (1 + 1e-5)).mean() > 0.95


def test_a_ball_is_not_cut_short(device):
    """Means over the points would lie inside of it by four times as much as is allowed here."""
    centre, radius = np.array([0.0, 0.0, -2.0]), 0.12

    def depth_at(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        ray = np.stack([(u - COLS / 2) / FOCAL, -(v - ROWS / 2) / FOCAL, -np.ones_like(u)], axis=-1)
        a, b = (ray * ray).sum(axis=-1), ray @ centre
        return (b - np.sqrt(np.maximum(b * b - a * (centre @ centre - radius**2), 0))) / a

    places = scattered(4)
    places = places[np.hypot(*(places - (COLS / 2, ROWS / 2)).T) < 18]
    found = resample(places, depth_at(*places.T), np.full(len(places), 1e-6), (ROWS, COLS), FOCAL, device=device)
    u, v = centres()
    inner = (np.hypot(u - COLS / 2, v - ROWS / 2) < 12) & (found.nearest >= 0)
    error = (found.depth - depth_at(u, v))[inner]
    sag = (WIDTH * 2.0 / FOCAL) ** 2 / radius  # of the mean under the weights: half the curvature, times both variances
    assert abs(error.mean()) < sag / 20 and np.sqrt((error**2).mean()) < sag / 4


def test_pixels_show_one_of_two_surfaces_and_never_something_between(device):
    places = scattered(5)
    near = places[:, 0] < COLS / 2
    depths = np.where(near, 1.9, 2.1)
    found = resample(places, depths, np.full(len(places), SIGMA), (ROWS, COLS), FOCAL, device=device)
    known = found.nearest >= 0
    assert (np.minimum(abs(found.depth - 1.9), abs(found.depth - 2.1))[known] < 1e-5).all()
    assert known.mean() > 0.9  # beside the step some pixels have points to one side alone


def test_holes_and_lines_stay_without_a_depth(device):
    places = scattered(6)
    hole = np.hypot(*(places - (25.0, 20.0)).T) < 6
    found = resample(places[~hole], plane(*places[~hole].T), np.full((~hole).sum(), SIGMA), (ROWS, COLS), FOCAL, device=device)
    u, v = centres()
    assert (found.nearest[np.hypot(u - 25, v - 20) < 6 - NEAREST] == -1).all()
    line = np.stack([np.linspace(0, COLS, 200), np.full(200, 20.3)], axis=1)
    assert (resample(line, plane(*line.T), np.full(200, SIGMA), (ROWS, COLS), FOCAL, device=device).nearest == -1).all()


def test_it_is_the_weighted_fit_of_least_squares(device):
    places = scattered(7)
    rng = np.random.default_rng(8)
    sigma = SIGMA * rng.uniform(0.5, 2, len(places))
    depths = plane(*places.T) + sigma * rng.standard_normal(len(places))
    found = resample(places, depths, sigma, (ROWS, COLS), FOCAL, device=device)
    inside = ((places >= 0) & (places < (COLS, ROWS))).all(axis=1)
    checked = 0
    for row, col in rng.integers((0, 0), (ROWS, COLS), (60, 2)):
        nearest = found.nearest[row, col]
        if nearest < 0:
            continue
        off = places - (col + 0.5, row + 0.5)
        around = inside & (np.abs(np.floor(places) - (col, row)) <= REACH).all(axis=1)
        weight = np.exp(-0.5 * (off[around] ** 2).sum(axis=1) / WIDTH**2) * (sigma[nearest] / sigma[around]) ** 2
        terms = np.stack([np.ones(around.sum()), *off[around].T, (off[around] ** 2).sum(axis=1)], axis=1)
        kernel = np.linalg.solve(terms.T @ (weight[:, None] * terms), (weight[:, None] * terms).T)[0]
        inverse = kernel @ (1 / depths[around])
        gauss = np.exp(-0.5 * (off[around] ** 2).sum(axis=1) / WIDTH**2)
        numbers = np.linalg.solve(terms.T @ (weight[:, None] * terms), terms.T @ (weight / depths[around]))
        residual = (1 / depths[around] - terms @ numbers) * depths[around] ** 2 / sigma[around]
        free = max(1 - 4 * (gauss**2).sum() / gauss.sum() ** 2, LEAST_FREE)
        if gauss @ residual**2 / (gauss.sum() * free) > (EXPLAINED - 0.05) ** 2:
            continue  # the fit is made again
        deviation = np.sqrt(((kernel * sigma[around] / depths[around] ** 2) ** 2).sum())
        assert found.depth[row, col] == pytest.approx(1 / inverse, abs=5e-6)  # single precision of the normal equations
        assert found.sigma[row, col] == pytest.approx(deviation / inverse**2, rel=1e-2)
        checked += 1
    assert checked > 30


@pytest.mark.parametrize("pixels", [0.6, 1.0, 2.4, 4.0])
def test_beside_steps_and_creases_sigma_says_what_is_not_known(device, pixels):
    """Steps of so many widths of a pixel, and a ridge as steep, which noise does not explain: little is more than 4 σ off both sides."""
    places = scattered(9)
    turn = 0.2
    width = 2.0 / FOCAL

    def beside(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return (u - COLS / 2) * np.cos(turn) + (v - ROWS / 2) * np.sin(turn)

    noise = SIGMA * np.random.default_rng(10).standard_normal(len(places))
    along = beside(*places.T)
    near = np.abs(beside(*centres())) < 2.5
    step = np.where(along < 0, 2, 2 + pixels * width), [np.full((ROWS, COLS), each) for each in (2.0, 2 + pixels * width)]
    ridge = 2 + pixels / 2 * width * np.abs(along), [2 + pixels / 2 * width * np.abs(beside(*centres()))]
    for truth, sides in (step, ridge):
        found = resample(places, truth + noise, np.full(len(places), SIGMA), (ROWS, COLS), FOCAL, device=device)
        known = found.nearest >= 0
        off = np.min([np.abs(found.depth - side) for side in sides], axis=0) / np.where(known, found.sigma, 1)
        assert known[near].mean() > 0.8
        # of less than 200 pixels, whose part scatters by 0.02; 18 to 36 % with one fit for each
        assert (off[near & known] > 4).mean() < 0.15 and (off[near & known] > 10).mean() < 0.03
