"""The projector's response from uniform levels."""

import numpy as np
import pytest

from service.calibrate.response import fit_response
from stage.errors import CalibrationError

RNG = np.random.default_rng(4)
AMBIENT, SCALE = RNG.uniform(0.02, 0.1, 500), np.where(np.arange(500) < 400, RNG.uniform(0.2, 0.8, 500), 0.0)


def images(levels, curve, noise=0.0):
    clean = AMBIENT + SCALE * curve(np.asarray(levels))[:, None]
    return (clean + RNG.normal(0, noise, clean.shape)).astype(np.float32)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.2])
def test_a_power_law_is_found(gamma):
    levels = np.linspace(0, 1, 9)
    found = fit_response(levels, images(levels, lambda x: x**gamma))
    assert found.gamma == pytest.approx(gamma, rel=1e-3)
    assert np.abs(found.values - np.linspace(0, 1, 256) ** gamma).max() < 1e-3
    assert (np.diff(found.values) > 0).all() and found.values[0] == 0 and found.values[-1] == 1


def test_levels_in_any_order_noise_and_an_s_curve():
    levels = np.linspace(0, 1, 17)[RNG.permutation(17)]

    def curve(x):
        return x * x * (3 - 2 * x)

    found = fit_response(levels, images(levels, curve, noise=0.01))
    assert np.abs(found.values - curve(np.linspace(0, 1, 256))).max() < 0.01
    assert 0.002 < found.spread < 0.05


def test_saturated_pixels_take_no_part():
    levels = np.linspace(0, 1, 9)
    seen = images(levels, lambda x: x)
    cut = np.minimum(seen, 0.3)
    found = fit_response(levels, cut, usable=(seen < 0.3).all(axis=0))
    assert np.abs(found.values - np.linspace(0, 1, 256)).max() < 1e-3


@pytest.mark.parametrize(("levels", "curve", "words"), [
    ([0, 1], lambda x: x, "three or more"),
    ([0, 0.5, 0.9], lambda x: x, "with 0 and 1"),
    ([0, 0.5, 0.5, 1], lambda x: x, "three or more different"),
    ([0, 0.3, 0.6, 1], lambda x: np.where(x == 0.6, 0.1, x), "the light falls from level 0.3 to 0.6"),
    ([0, 0.5, 1], lambda x: 0 * x, "only 0 pixels get brighter"),
])
def test_what_cannot_be_a_response_is_named(levels, curve, words):
    with pytest.raises(CalibrationError, match=words):
        fit_response(levels, images(levels, curve))
