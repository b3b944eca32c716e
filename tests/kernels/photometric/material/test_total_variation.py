"""Maps of least total variation, against an exact minimum and on maps whose answer is plain."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.photometric.material.total_variation import STEPS, between, least_variation

ROWS, COLS = 14, 20


def linked(shape, strength):
    return [np.full(np.zeros(shape)[between(step)[0]].shape, strength / np.hypot(*step), np.float32) for step in STEPS]


def chain_minimum(values, trust, links):
    """The least cost on a chain of pixels by dynamic programming: its maps take no value but given ones."""
    levels = np.unique(values)
    best = trust[0] * np.abs(levels - values[0])
    for value, weight, link in zip(values[1:], trust[1:], links, strict=True):
        best = (best[:, None] + link * np.abs(levels[:, None] - levels)).min(axis=0) + weight * np.abs(levels - value)
    return best.min()


@pytest.mark.parametrize("seed", range(4))
def test_a_chain_of_pixels_reaches_the_least_cost(device, seed):
    """Tolerance: 150 steps are not the limit, and 2 % of the cost is far less than the noise of what pixels say."""
    rng = np.random.default_rng(seed)
    values, trust, link = rng.random(40), rng.uniform(0.1, 2, 40), rng.uniform(0, 1, 39)
    links = [link[None].astype(np.float32), *(np.zeros(np.zeros((1, 40))[between(step)[0]].shape, np.float32) for step in STEPS[1:])]
    found = least_variation(values[None, None], trust[None], links, device=device)[0, 0]
    cost = (trust * np.abs(found - values)).sum() + (link * np.abs(np.diff(found))).sum()
    least = chain_minimum(values, trust, link)
    assert least <= cost * 1.0001 and cost < 1.02 * least


def test_speckle_goes_and_borders_and_slopes_stay(device):
    """Pixels that are hardly trusted say anything; a step between trusted pixels and a slope of them are no speckle."""
    rng = np.random.default_rng(0)
    step = np.where(np.arange(COLS) < COLS // 2, 0.2, 0.6) * np.ones((ROWS, 1))
    slope = np.linspace(0.2, 0.8, COLS) * np.ones((ROWS, 1))
    doubtful = rng.random((ROWS, COLS)) < 0.2
    for truth in (step, slope):
        said = np.where(doubtful, rng.random((ROWS, COLS)), truth)
        found = least_variation(said[None], np.where(doubtful, 0.02, 1.2), linked((ROWS, COLS), 0.3), device=device)[0]
        assert np.abs(said - truth)[doubtful].mean() > 0.2
        assert np.abs(found - truth).mean() < 0.02


def test_no_value_lies_beyond_those_that_pixels_say(device):
    """One sure pixel among unsure ones: steps towards the minimum overshoot, here by 8 %. An F0 below 0 would be none."""
    said, trust = np.zeros((1, 8, 8)), np.full((8, 8), 1e-6)
    said[0, :, 4:], said[0, 0, 0], trust[0, 0] = 1, 1, 1
    found = least_variation(np.concatenate([said, -said]), trust, linked((8, 8), 0.5), device=device)
    assert found.max() == 1 and found.min() == -1


def test_pixels_without_links_and_other_planes_change_nothing(device):
    rng = np.random.default_rng(1)
    values, trust = rng.random((3, ROWS, COLS)), rng.random((ROWS, COLS))
    np.testing.assert_array_equal(least_variation(values, trust, linked((ROWS, COLS), 0.0), device=device), values.astype(np.float32))
    links = linked((ROWS, COLS), 0.5)
    np.testing.assert_array_equal(least_variation(values, trust, links, device=device)[1],
                                  least_variation(values[1:2], trust, links, device=device)[0])
    with pytest.raises(ArrayError, match="one link for each pair"):
        least_variation(values, trust, links[:3], device=device)
