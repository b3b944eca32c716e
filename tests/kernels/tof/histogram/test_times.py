"""Standard deviation and confidence of histogram ranges: against errors that are observed, and against a posterior by trying everything."""

import numpy as np
import pytest
from scipy.special import ndtr

from kernels.tof.histogram.pileup import correct_pileup, place, without_pileup
from kernels.tof.histogram.pulse import gaussian
from kernels.tof.histogram.returns import find_returns
from tests.reference import tof

pytestmark = pytest.mark.long
BINS = 64


def draw(photons, sigma_bins, background, *, seed, pulses=None, second=None):
    """Times anywhere within the bins, and histograms; `second` is (bins behind, part of the photons)."""
    random = np.random.default_rng(seed)
    time = random.uniform(6, BINS - 20, len(photons))
    mean = np.full((len(photons), BINS), background)
    for behind, part in ((0.0, 1.0), *([second] if second else [])):
        mean += part * photons[:, None] * np.diff(ndtr((np.arange(BINS + 1) - behind - time[:, None]) / sigma_bins), axis=1)
    if pulses is None:
        return time, random.poisson(mean).astype(float)
    first = np.exp(-(np.cumsum(mean, axis=1) - mean) / pulses) * -np.expm1(-mean / pulses)
    return time, random.multinomial(pulses, np.concatenate([first, 1 - first.sum(axis=1, keepdims=True)], axis=1))[:, :-1].astype(float)


def solve(counts, sigma_bins, device, *, pulses=None, most=1):
    placed = place(counts, device)
    histograms = without_pileup(placed) if pulses is None else correct_pileup(placed, pulses=pulses)
    found = find_returns(histograms, gaussian(sigma_bins), most=most)
    return {name: getattr(found, name).numpy() for name in found._fields}


def log_uniform(low, high, count=20000):
    return np.exp(np.random.default_rng(9).uniform(np.log(low), np.log(high), count))


def fifths(error, sigma):
    """Error over sigma, in fifths of the pixels by sigma."""
    return [(error / sigma)[part] for part in np.array_split(np.argsort(sigma), 5)]


@pytest.mark.parametrize(("sigma_bins", "background", "low", "high"), [
    (0.8, 0.02, 5, 60), (0.8, 60.0, 60, 400), (4.0, 2.0, 30, 300), (0.3, 0.5, 8, 100)])
def test_sigma_is_the_error_at_low_counts(sigma_bins, background, low, high, device):
    """In each fifth of the pixels, from those told best to those told worst; the median of 2400 errors scatters by 2.6 %. With the Fisher
    information, and no more than a bin over √12, sigma was too small up to 2.3 times."""
    time, counts = draw(log_uniform(low, high, 12000), sigma_bins, background, seed=1)
    found = solve(counts, sigma_bins, device)
    error, sigma = found["position"][0] - time, found["sigma"][0]
    right = (found["photons"][0] > 0) & (np.abs(error) < 4 * sigma_bins)
    assert right.mean() > 0.6
    for part in fifths(error[right], sigma[right]):
        assert 1.4826 * np.median(np.abs(part)) == pytest.approx(1, abs=0.1)
        assert np.sqrt(np.mean(np.clip(part, -4, 4) ** 2)) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(("sigma_bins", "photons"), [(0.05, 20.0), (0.1, 2000.0), (0.2, 20.0)])
def test_sigma_is_the_error_of_pulses_that_hide_in_a_bin(sigma_bins, photons, device):
    """Errors are even over what the bin leaves open there, and not normal: RMS alone."""
    time, counts = draw(np.full(12000, photons), sigma_bins, 0.5, seed=2)
    found = solve(counts, sigma_bins, device)
    error, sigma = found["position"][0] - time, found["sigma"][0]
    right = (found["photons"][0] > 0) & (np.abs(error) < 1.5)
    assert np.median(sigma[right]) < 0.3  # a bin over √12, and what few photons add
    for part in fifths(error[right], sigma[right]):
        assert np.sqrt(np.mean(np.clip(part, -4, 4) ** 2)) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(("photons", "pulses"), [(400, 2000), (400, 500), (2000, 500)])
def test_sigma_knows_what_pile_up_costs(photons, pulses, device):
    """At four photons a pulse the logarithm of what is left makes errors 1.4 times those of Poisson counts."""
    time, counts = draw(log_uniform(0.7 * photons, 1.4 * photons), 0.8, 0.5, seed=3, pulses=pulses)
    found = solve(counts, 0.8, device, pulses=pulses)
    part = (found["position"][0] - time) / found["sigma"][0]
    assert np.sqrt(np.mean(part**2)) == pytest.approx(1, abs=0.04)  # 20000 errors scatter by half a per cent; 0.1 sigma of bias is left
    assert 1.4826 * np.median(np.abs(part)) == pytest.approx(1, abs=0.04)


@pytest.mark.parametrize("apart", [2.5, 3.0, 6.0])
def test_two_returns_that_overlap_are_at_their_places_with_their_errors(apart, device):
    """Pulses of two bins, `apart` of their standard deviations apart."""
    time, counts = draw(np.full(3000, 2000.0), 2.0, 0.5, seed=4, second=(2.0 * apart, 0.5))
    found = solve(counts, 2.0, device, most=3)
    both = (found["photons"][1] > 0) & (found["photons"][2] == 0)
    assert both.mean() > 0.75
    order = np.argsort(found["position"][:2], axis=0)
    position, sigma = (np.take_along_axis(found[name][:2], order, axis=0)[:, both] for name in ("position", "sigma"))
    for index, behind in enumerate((0.0, 2.0 * apart)):
        part = (position[index] - time[both] - behind) / sigma[index]
        assert abs(np.median(part)) < 0.2  # noise sets which of the closest pairs are told apart
        assert 1.4826 * np.median(np.abs(part)) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(("sigma_bins", "photons", "pulses"), [(0.8, 8, None), (0.8, 100, None), (0.15, 12, None), (3.0, 40, None),
                                                               (0.8, 900, 300)])
def test_the_posterior_is_that_of_the_twin(sigma_bins, photons, pulses, device):
    _, counts = draw(np.full(10, float(photons)), sigma_bins, 0.2, seed=5, pulses=pulses)
    found = solve(counts, sigma_bins, device, pulses=pulses)
    reach = 0.5 * gaussian(sigma_bins).width + 1
    for pixel in np.nonzero(found["photons"][0] > 0)[0]:
        sigma = float(found["sigma"][0, pixel])
        place, spread = tof.time_posterior(counts[pixel], found["background"][pixel], sigma_bins, found["position"][0, pixel], reach,
                                           pulses=pulses)
        assert place == pytest.approx(found["position"][0, pixel], abs=0.05 * sigma)  # the peak is cut about another middle there
        assert spread == pytest.approx(sigma, rel=0.05)


@pytest.mark.parametrize(("background", "low", "high", "clear", "pixels"), [(0.05, 1, 40, 12, 100000), (2.0, 3, 80, 30, 250000)])
def test_confidence_is_how_often_the_peak_is_right(background, low, high, clear, pixels, device):
    """Every other pixel has no return: those that are accepted and wrong are as many as confidence says. There are more than 30 of them,
    whose number scatters by a sixth, and how bright returns are is not known beforehand: within a factor of two. Pixels are solved one
    by one, and brighter ones than `clear`, which are never wrong, are left out."""
    photons = log_uniform(low, high, pixels)
    photons[::2] = 0
    photons = photons[photons < clear]
    time, counts = draw(photons, 0.8, background, seed=6)
    found = solve(counts, 0.8, device)
    accepted = found["photons"][0] > 0
    wrong = accepted & ((photons == 0) | (np.abs(found["position"][0] - time) > 4 * 0.8))
    said = (1 - found["confidence"][0])[accepted].sum()
    assert wrong.sum() > 30
    assert 0.5 < said / wrong.sum() < 2
    doubtful = accepted & (found["confidence"][0] < 0.99)
    assert 0.4 < (1 - found["confidence"][0])[doubtful].mean() / wrong[doubtful].mean() < 2.5
