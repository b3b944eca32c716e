"""Halves of the kernel are NumPy's, bit by bit."""

import numpy as np
import pytest

from kernels.half import to_half


@pytest.mark.parametrize("shape", [(1,), (31,), (32,), (3, 1000), (0,), (2, 0, 5)])
def test_values_are_those_of_numpy(shape):
    values = np.random.default_rng(1).normal(0, 300, shape).astype(np.float32)
    np.testing.assert_array_equal(to_half(values).view(np.uint16), values.astype(np.float16).view(np.uint16))


def test_every_half_and_the_middles_between_them_round_alike():
    """Ties, denormals, both zeros, infinities and values beyond the largest half."""
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    kept = halves[~np.isnan(halves)].astype(np.float32)
    middles = np.concatenate([(kept[:-1] + kept[1:]) / 2, np.float32([65519.9, 65520, -65520, 1e30])])
    for values in (kept, middles[~np.isnan(middles)]):
        with np.errstate(over="ignore"):
            expected = values.astype(np.float16)
        np.testing.assert_array_equal(to_half(values).view(np.uint16), expected.view(np.uint16))


def test_what_is_no_number_stays_none():
    assert np.isnan(to_half(np.full(70, np.nan, np.float32))).all()


def test_a_part_of_an_array_is_converted():
    whole = np.random.default_rng(2).normal(size=(4, 90)).astype(np.float32)
    np.testing.assert_array_equal(to_half(whole[:, 3:70]), whole[:, 3:70].astype(np.float16))
