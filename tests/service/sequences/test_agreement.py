"""Which estimates agree: noise does, motion does not, and the recursive mean is never worse than the last estimate."""

import numpy as np
import pytest

from service.sequences.agreement import advance, agree, begin, noise_share, steady
from tests.marks import first_short

SIDE = 96
ALL = np.ones((SIDE, SIDE), bool)
SIGMA = np.radians(0.5)


def sphere(place: float) -> np.ndarray:
    """[rows, cols, 3] normals of a cap whose middle is this many pixels off."""
    rows, cols = np.indices(ALL.shape)
    x, y = (cols - SIDE / 2 - place) / 60, (rows - SIDE / 2) / 60
    normal = np.stack([-0.8 * x, -0.8 * y, np.ones_like(x)], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def noisy(truth: np.ndarray, random: np.random.Generator, sigma: float = SIGMA) -> np.ndarray:
    raw = truth + random.normal(size=truth.shape) * sigma / np.sqrt(2)
    return raw / np.linalg.norm(raw, axis=-1, keepdims=True)


def followed(speed: float, *, declared: float = SIGMA, steps: int = 12) -> list[tuple[float, float, float]]:
    """Of each step after the first the error of the mean and of the step alone (root mean square), and the σ of the mean."""
    random = np.random.default_rng(0)
    sigma = np.full(ALL.shape, declared)
    track, before, found = None, None, []
    for step in range(steps):
        truth = sphere(speed * step)
        raw = noisy(truth, random)
        if track is None or before is None:
            track = begin(raw, sigma, np.ones(ALL.shape), ALL)
        else:
            share = noise_share(raw - before, 2 * sigma**2, ALL, 2)
            if step == 1:
                track = begin(before, sigma, share, ALL)
            new = begin(raw, sigma, share, ALL)
            rest = agree(raw - track.mean, track.noise + new.noise, ALL, 2)
            track = advance(track, new, rest & steady(track, new, rest, 2, unit=True), unit=True)
            mean, alone = (np.sqrt(((each - truth) ** 2).sum(axis=-1).mean()) for each in (track.mean, raw))
            found.append((mean, alone, np.sqrt((track.sigma**2).mean())))
        before = raw
    return found


def test_the_error_at_rest_falls_by_the_root_of_the_steps():
    """0.6 % of the pixels begin anew in a step, so that the mean square is up to 1/k + 0.006 k of that alone; σ says so within 15 %."""
    for number, (mean, alone, sigma) in enumerate(followed(0.0), start=2):
        assert mean < alone * np.sqrt(1 / number + 0.006 * number)
        assert sigma == pytest.approx(mean, rel=0.15)


@pytest.mark.long
@pytest.mark.parametrize("speed", [0.02, 0.05, 0.1, 0.2, 0.5, 1, 3, 10])
@pytest.mark.parametrize("declared", [1.0, 4.0])
def test_no_motion_makes_the_mean_worse_than_a_step_alone(speed, declared):
    """From motion of a hundredth of σ a step to one of many; half a per cent is left to pixels that agree by chance."""
    for mean, alone, _ in followed(speed, declared=declared * SIGMA):
        assert mean < 1.005 * alone


@first_short(("side", "speed", "before", "bound"), [(3, 0.1, 0.28, 0.08), (5, 0.3, 0.15, 0.05), (9, 1.0, 0.03, 0.015)])
def test_sigma_holds_by_how_much_the_mean_of_a_small_thing_that_moves_slowly_lags(side, speed, before, bound):
    """A square of some pixels that moves by a part of σ a step, for 40 steps: pixels beyond five σ. `before`: their share without the mean
    of the last steps; the bounds are twice and more what is left of it (.028, .016, .005)."""
    random, beyond, at_rest = np.random.default_rng(0), [], []
    moves = np.zeros(ALL.shape, bool)
    moves[48 - side // 2 : 49 + side // 2, 48 - side // 2 : 49 + side // 2] = True
    track = None
    for step in range(40):
        truth = np.where(moves, speed * step, 0.0)[..., None]
        new = begin(truth + random.normal(size=truth.shape), np.ones(ALL.shape), np.ones(ALL.shape), ALL)
        if track is not None:
            rest = agree(new.mean - track.mean, track.noise + new.noise, ALL, 1)
            track = advance(track, new, rest & steady(track, new, rest, 1))
            over = np.abs(track.mean - truth)[..., 0] / track.sigma
            beyond.append(np.mean(over[moves] > 5))
            at_rest.append(np.median(over[~moves]))
        else:
            track = new
    assert np.mean(beyond) < bound < before
    assert np.mean(at_rest) == pytest.approx(0.67, abs=0.1)  # the median of the magnitude of normal errors


def test_the_share_of_noise_is_measured_though_everything_moves():
    """σ declared four times too large: noise is a sixteenth of its square, within what 9000 pixels tell."""
    random = np.random.default_rng(1)
    declared = np.full(ALL.shape, 2 * (4 * SIGMA) ** 2)
    for place in (0.0, 2.0):
        share = noise_share(noisy(sphere(place), random) - noisy(sphere(0), random), declared, ALL, 2)
        assert np.median(share) == pytest.approx(1 / 16, rel=0.1)


def test_errors_that_all_steps_share_are_not_averaged_away():
    random = np.random.default_rng(2)
    fault = 3 * SIGMA * np.array([1.0, 0.0, 0.0])
    truth, sigma = sphere(0), np.full(ALL.shape, np.sqrt(10) * SIGMA)
    steps = [noisy(truth, random) + fault for _ in range(10)]
    share = noise_share(steps[1] - steps[0], 2 * sigma**2, ALL, 2)
    track = begin(steps[0], sigma, share, ALL)
    for step in steps[1:]:
        track = advance(track, begin(step, sigma, share, ALL), ALL)
    assert np.sqrt((track.sigma**2).mean()) == pytest.approx(np.sqrt(9 + 0.1) * SIGMA, rel=0.05)


def test_a_cut_carries_nothing_over_and_steps_without_noise_weigh_the_same():
    random = np.random.default_rng(3)
    one, other = noisy(sphere(0), random), noisy(-sphere(20) * (1, 1, -1), random)
    assert not agree(other - one, np.full(ALL.shape, 2 * SIGMA**2), ALL, 2).any()
    ones = np.zeros((4, 4, 1))
    still = np.zeros((4, 4))
    track = begin(ones, still, still, np.ones((4, 4), bool))
    for value in (3.0, 6.0):
        track = advance(track, begin(ones + value, still, still, np.ones((4, 4), bool)), np.ones((4, 4), bool))
    np.testing.assert_allclose(track.mean, 3)


def test_missing_estimates_agree_with_nothing_and_begin_anew():
    both = ALL.copy()
    both[:, :20] = False
    zero = np.zeros((SIDE, SIDE, 1))
    found = agree(zero, np.ones(ALL.shape), both, 1)
    assert not found[:, :20].any() and found[:, 24:].all()
    track = advance(begin(zero, np.ones(ALL.shape), np.ones(ALL.shape), both), begin(zero + 1, np.ones(ALL.shape), np.ones(ALL.shape), ALL),
                    found)
    assert (track.mean[:, :20] == 1).all() and (track.mean[:, 24:] == 0.5).all()
    assert (track.count[:, :20] == 1).all() and (track.count[:, 24:] == 2).all()
