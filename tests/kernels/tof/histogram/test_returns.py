"""Histograms: sub-bin ranges, low counts, several returns, background, pile-up, pulses."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.tof.histogram.pileup import correct_pileup, place, without_pileup
from kernels.tof.histogram.pulse import gaussian, measured
from kernels.tof.histogram.pulse_width import estimate_pulse
from kernels.tof.histogram.returns import find_returns
from tests.reference import tof

BIN_S, SIGMA_S = 1.5e-9, 1.2e-9
BIN_M = tof.LIGHT * BIN_S / 2
PULSE = gaussian(SIGMA_S / BIN_S)


def solve(counts, device, *, pulses=None, pulse=PULSE, **options):
    flat = counts.reshape(-1, counts.shape[-1])
    placed = place(flat, device)
    histograms = without_pileup(placed) if pulses is None else correct_pileup(placed, pulses=pulses)
    found = find_returns(histograms, pulse, **options)
    return {name: getattr(found, name).numpy() for name in found._fields}


def flat_view(distance, albedo=0.8):
    distance = np.atleast_2d(distance)
    return tof.View(distance, np.full(distance.shape, albedo), np.ones(distance.shape))


def test_without_noise_ranges_are_exact_between_the_bins(device):
    view = flat_view(np.linspace(0.6, 13.0, 500))
    found = solve(tof.histogram(view, 4e5), device)
    assert np.abs(found["position"][0] * BIN_M - view.distance.reshape(-1)).max() < 1e-4  # float32 tables
    np.testing.assert_allclose(found["photons"][0], tof.signal(view, 4e5).reshape(-1), rtol=1e-3)
    np.testing.assert_allclose(found["background"], 0.5, atol=0.04)  # the table ends where 7 in a million of a return are left


@pytest.mark.parametrize(("part", "median_m"), [(1.0, 0.020), pytest.param(0.2, 0.046, marks=pytest.mark.long)])
def test_noise_figures_of_the_room(part, median_m, device):
    """Reach: median error with 4000 counts at one metre, and a fifth of it; sigma against what is observed."""
    view = tof.room()
    found = solve(tof.histogram(view, 4000 * part, background=0.05, seed=3), device)
    ok = found["status"] == Status.OK
    error = found["position"][0] * BIN_M - view.distance.reshape(-1)
    assert ok.mean() > 0.6
    assert np.median(np.abs(error[ok])) <= median_m
    assert np.sqrt(np.mean((error[ok] / (found["sigma"][0][ok] * BIN_M)) ** 2)) == pytest.approx(1, abs=0.05)


def test_pile_up_with_noise_has_no_bias(device):
    view = flat_view(np.full(4000, 1.0))
    found = solve(tof.histogram(view, 4000, pulses=2000, seed=1), device, pulses=2000)
    error = found["position"][0] * BIN_M - 1.0
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(4000) + 1e-3
    assert found["sigma"][0].mean() * BIN_M == pytest.approx(error.std(), rel=0.1)


def test_coates_is_that_of_the_twin(device):
    counts = tof.histogram(flat_view(np.array([1.0, 3.0])), 4000, pulses=1000, seed=0).reshape(2, -1)
    histograms = correct_pileup(place(counts, device), pulses=1000)
    flux = histograms.counts.numpy() / np.maximum(histograms.live.numpy(), 1e-9)
    for pixel in range(2):
        np.testing.assert_allclose(flux[:, pixel], tof.first_photon_flux(counts[pixel], 1000), rtol=1e-4, atol=1e-3)


def test_a_histogram_whose_pulses_are_all_used_up_says_so(device):
    counts = np.zeros((2, 16))
    counts[0, 0] = 500  # nothing is left after the first bin
    counts[1, 5] = 100
    assert list(solve(counts, device, pulses=500)["status"]) == [Status.SATURATED, Status.OK]


def test_pulses_that_are_used_up_within_a_return_do_not_move_it(device):
    """Six photons a pulse, and next to no pulse for the bins behind."""
    view = flat_view(np.linspace(2.0, 2.6, 4000))
    scaled = tof.View(view.distance, view.albedo / tof.signal(view, 1.0), view.cosine)
    counts = tof.histogram(scaled, 3000 / 0.8, background=0.2, pulses=500, seed=1)
    found = solve(counts, device, pulses=500)
    error = found["position"][0] * BIN_M - view.distance.reshape(-1)
    assert np.mean(counts.sum(axis=-1) == 500) > 0.1
    assert abs(error.mean()) < 0.2 * error.std()
    assert np.sqrt(np.mean((error / (found["sigma"][0] * BIN_M)) ** 2)) == pytest.approx(1, abs=0.1)


def test_several_returns_are_told_apart(device):
    view = flat_view(np.linspace(1, 8, 300))
    found = solve(tof.histogram(view, 60000, seed=2, second=(2.0, 0.5)), device, most=3)
    both = found["photons"][1] > 0
    assert both.mean() > 0.95
    near, far = np.sort(found["position"][:2], axis=0) * BIN_M
    assert np.median(np.abs(near - view.distance.reshape(-1))[both]) < 0.02
    assert np.median(np.abs(far - view.distance.reshape(-1) - 2.0)[both]) < 0.03
    assert np.mean(found["photons"][2] > 0) < 0.02


def test_background_alone_is_no_return(device):
    counts = np.random.default_rng(0).poisson(3.0, (5000, 64))
    assert np.mean(solve(counts, device)["status"] == Status.OK) < 3e-3  # one in a thousand


def test_an_empty_histogram_is_a_status_and_all_of_them_an_error(device):
    counts = np.zeros((2, 64))
    counts[0, 20:23] = 10, 30, 12
    assert list(solve(counts, device)["status"]) == [Status.OK, Status.LOW_MODULATION]
    with pytest.raises(ArrayError, match="every histogram is empty"):
        place(np.zeros((2, 64)), device)


@pytest.mark.long
@pytest.mark.parametrize("sigma_s", [0.7e-9, 1.2e-9, 3e-9])
def test_the_pulse_is_estimated(sigma_s, device):
    counts = tof.histogram(tof.room(24, 32), 20000, sigma_s=sigma_s, seed=5).reshape(-1, 64)
    histograms = without_pileup(place(counts, device))
    truth = gaussian(sigma_s / BIN_S)
    assert estimate_pulse(histograms, counts).pulse.step == pytest.approx(truth.step, rel=0.06)


@pytest.mark.long
@pytest.mark.parametrize("photons", [6, 20])
def test_few_photons_do_not_make_the_pulse_narrow(photons, device):
    """A time fitted to each histogram of n photons takes a part 1/n of their variance: 0.91 of the width at six, were it not counted in."""
    view = flat_view(np.linspace(3.0, 4.0, 2000))
    scaled = tof.View(view.distance, view.albedo / tof.signal(view, 1.0), view.cosine)
    counts = tof.histogram(scaled, photons / 0.8, background=0.01, seed=8).reshape(-1, 64)
    estimated = estimate_pulse(without_pileup(place(counts, device)), counts)
    assert estimated.pulse.step == pytest.approx(PULSE.step, rel=0.04)  # 512 histograms of six: 1.3 %, and the brightest are not just any


def test_bad_pulses_and_options_are_refused(device):
    with pytest.raises(ArrayError, match="times of the pulse are out of order: number 2"):
        measured([0, 2, 1], [0, 1, 0])
    with pytest.raises(ArrayError, match="zero or more"):
        measured([0, 1, 2], [0, -1, 0])
    with pytest.raises(ArrayError, match="above zero"):
        gaussian(0.0)
    counts = np.ones((1, 8))
    with pytest.raises(ArrayError, match="5 returns are asked for"):
        solve(counts, device, most=5)
    with pytest.raises(ArrayError, match="leave no place"):
        solve(counts, device, first_bin=8)
    with pytest.raises(ArrayError, match="pulses is 0"):
        correct_pileup(place(counts, device), pulses=0)
    with pytest.raises(ArrayError, match="negative"):
        place(-counts, device)
    with pytest.raises(ArrayError, match="three bins"):
        place(np.ones((4, 2)), device)
