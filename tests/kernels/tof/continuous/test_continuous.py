"""Correlation images to phases: closed forms, any set of reference phases, noise, and what must not be taken for signal."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.tof.continuous.continuous import Noise, decode, weights
from kernels.tof.continuous.modulation import common_range_m, radians_per_metre, require_ascending, require_span
from tests.reference import tof
from tests.reference.tof import LIGHT

SHOT = Noise(1.0, 5.0)
FLOAT = 4e-7
"""Of a phase in float32 near a turn, with the arctangent's own 3e-8."""


def one(images, hz, delta, device, **options):
    found = decode(np.asarray(images, dtype=np.float32), hz, delta, noise=SHOT, device=device, **options)
    pixels = np.shape(images)[1]
    return {name: getattr(found, name).numpy()[:, :pixels] for name in ("phase", "sigma", "amplitude", "offset", "evidence", "residual")}


@pytest.mark.parametrize("delta", [
    [0, 2 * np.pi / 3, 4 * np.pi / 3], [0, np.pi / 2, np.pi, 3 * np.pi / 2], [0.3, 1.0, 2.9, 4.0, 5.5], [0, 1.0, 2.5],
    [0, 0, np.pi / 2, np.pi, 3 * np.pi / 2 - 4 * np.pi],
])
def test_any_phases_give_phase_amplitude_and_offset(delta, device):
    true = np.linspace(0, 2 * np.pi, 97, endpoint=False)
    delta = np.array(delta)
    found = one(700 + 300 * np.cos(true - delta[:, None]), np.full(len(delta), 30e6), delta, device)
    away = np.angle(np.exp(1j * (found["phase"][0] - true)))
    assert np.abs(away).max() < 10 * FLOAT  # readings are rounded to float32 too
    assert found["phase"].min() >= 0 and found["phase"].max() <= 2 * np.pi
    np.testing.assert_allclose(found["amplitude"][0], 300, rtol=1e-5)
    np.testing.assert_allclose(found["offset"][0], 700, rtol=1e-5)


def test_images_in_any_order_are_those_of_the_twin(device):
    settings = tof.even(tof.HZ, 3)
    images = tof.correlations(tof.room(12, 20), 1e5, settings, seed=3).reshape(9, -1)
    shuffled = np.random.default_rng(0).permutation(9)
    hz, delta = (np.array(column)[shuffled] for column in zip(*settings, strict=True))
    found = one(images[shuffled], hz, delta, device)
    for f, frequency in enumerate(tof.HZ):
        mine = hz == frequency
        level, amplitude, phase = tof.phases(images[shuffled][mine], delta[mine])
        np.testing.assert_allclose(found["offset"][f], level, rtol=1e-4)
        np.testing.assert_allclose(found["amplitude"][f], amplitude, rtol=1e-3, atol=0.1)
        assert np.abs(np.angle(np.exp(1j * (found["phase"][f] - phase)))).max() < 1e-4  # float32 sums of large offsets


def test_sigma_is_what_repeats_show(device):
    rng = np.random.default_rng(1)
    delta = np.arange(4) * np.pi / 2
    mean = 900 + 400 * np.cos(1.1 - delta)
    images = rng.poisson(mean[:, None], (4, 40000)) + rng.normal(0, 5, (4, 40000))
    found = one(images, np.full(4, 20e6), delta, device)
    assert found["sigma"].mean() == pytest.approx(found["phase"].std(), rel=0.02)  # 40 000 repeats: 0.4 %
    assert found["residual"].mean() == pytest.approx(mean.mean() + 25, rel=0.03)  # one image beyond three


def test_unequal_exposures_are_scaled(device):
    delta, scale = np.arange(4) * np.pi / 2, np.array([1, 2, 0.5, 1])
    images = (500 + 200 * np.cos(2.0 - delta)) / scale
    found = one(images[:, None], np.full(4, 20e6), delta, device, scale=scale)
    assert found["phase"][0, 0] == pytest.approx(2.0, abs=1e-6)
    assert found["amplitude"][0, 0] == pytest.approx(200, rel=1e-6)


def test_ambient_alone_is_no_signal(device):
    images = np.full((4, 5), 30000.0)
    found = one(images, np.full(4, 20e6), np.arange(4) * np.pi / 2, device)
    assert found["evidence"].max() < 1e-6


def test_saturated_and_impossible_readings_blind_the_frequency(device):
    images = np.full((4, 3), 100.0) + np.arange(4)[:, None]
    images[2, 1], images[0, 2] = 4000.0, np.nan
    found = one(images, np.full(4, 20e6), np.arange(4) * np.pi / 2, device, saturation=4000.0)
    assert list(found["sigma"][0] < 0) == [False, True, True]
    assert np.isfinite(np.concatenate(list(found.values()))).all()


@pytest.mark.parametrize(("hz", "delta", "message"), [
    ([20e6, 20e6], [0, 1], "20 MHz has 2 different reference phases: phase, amplitude"),
    ([20e6] * 3, [1, 1, 1], "has 1 different reference phase:"),
    ([20e6] * 3, [0, 2 * np.pi, 1], "has 2 different"),
    ([20e6] * 3, [0, 1e-3, 2e-3], "lie too close together"),
    ([0.0] * 3, [0, 1, 2], "above zero"),
    ([-1e6] * 3, [0, 1, 2], "above zero"),
    ([20e6] * 3, [0, 1], "give one an image"),
    ([20e6] * 3, [0, 1, np.nan], "finite"),
])
def test_settings_that_give_no_phase_are_refused(hz, delta, message):
    with pytest.raises(ArrayError, match=message):
        weights(hz, delta)


def test_images_of_the_wrong_number_are_refused(device):
    with pytest.raises(ArrayError, match="2 images and 3 reference phases"):
        decode(np.zeros((2, 4), np.float32), [20e6] * 3, [0, 2, 4], noise=SHOT, device=device)
    with pytest.raises(ArrayError, match="float64"):
        decode(np.zeros((3, 4)), [20e6] * 3, [0, 2, 4], noise=SHOT, device=device)


@pytest.mark.parametrize(("hz", "base"), [((20e6, 30e6, 80e6), 10e6), ((16e6, 80e6, 120e6), 8e6), ((30e6,), 30e6), ((20e6, 20e6), 20e6),
                                          ((100e6, 30e6), 10e6)])
def test_common_range_is_that_of_the_common_divisor(hz, base):
    assert common_range_m(hz, LIGHT) == pytest.approx(LIGHT / (2 * base))


def test_a_metre_is_four_pi_f_over_c():
    assert radians_per_metre([30e6], LIGHT)[0] * 2.498270483 == pytest.approx(np.pi, rel=1e-8)


def test_a_span_beyond_the_common_range_is_refused_and_the_range_said():
    require_span((20e6, 30e6), 0, 14.98, LIGHT)
    with pytest.raises(ArrayError, match=r"20, 30 MHz repeat after 14.99 m, 20 m were asked for"):
        require_span((20e6, 30e6), 0, 20, LIGHT)
    with pytest.raises(ArrayError, match="no span"):
        require_span((20e6, 30e6), 3, 2, LIGHT)


@pytest.mark.parametrize("hz", [(), (0.0,), (-20e6,), (np.nan,), (20e6, np.inf)])
def test_frequencies_must_be_above_zero(hz):
    with pytest.raises(ArrayError, match="above zero"):
        radians_per_metre(hz, LIGHT)


def test_times_must_ascend():
    require_ascending([0, 1, 2], "bins")
    with pytest.raises(ArrayError, match="bins are out of order: number 2"):
        require_ascending([0, 2, 1], "bins")
