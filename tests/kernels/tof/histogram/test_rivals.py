"""The neighbours' vote on weak returns, and what tells that counts, pulses and pile-up are other than declared."""

import numpy as np
import pytest
from scipy.special import ndtr

from kernels.errors import ArrayError
from kernels.tof.histogram.misfit import misfit
from kernels.tof.histogram.pileup import place, without_pileup
from kernels.tof.histogram.pulse import gaussian, with_tail
from kernels.tof.histogram.returns import find_returns
from kernels.tof.histogram.rivals import vote_on_returns
from kernels.tof.histogram.undeclared_pileup import estimate_pulses
from service.depth.tof.count_scale import estimate_count_scale
from service.depth.tof.histograms import interlaced
from service.depth.tof.shared_light import pattern_bins
from tests.reference import tof

BINS = 64
PULSE = gaussian(0.8)


def vote(counts, device):
    rows, cols = counts.shape[:2]
    histograms = without_pileup(place(counts.reshape(-1, BINS), device))
    found = find_returns(histograms, PULSE, most=3)
    return found, vote_on_returns(histograms, PULSE, found, rows, cols, usable=np.ones(rows * cols, dtype=bool), first_bin=0.0,
                                  last_bin=float(BINS))


def wall(rows, cols, photons, background, seed, time=30.3):
    mean = background + photons * np.diff(ndtr((np.arange(BINS + 1) - time) / 0.8))
    return np.random.default_rng(seed).poisson(mean, (rows, cols, BINS)).astype(float)


def test_confidence_after_the_vote_is_no_less_than_the_share_of_right_peaks(device):
    """Seven photons over half a photon a bin: by significance alone less than half of the pixels have a return."""
    found, voted = vote(wall(48, 48, 7.0, 0.5, 1), device)
    right = np.abs(voted.position - 30.3) < 3
    assert (found.photons.numpy()[0] > 0).mean() < 0.5
    assert (right & (voted.confidence > 0.95)).mean() > 0.75
    for low, high in ((0.5, 0.8), (0.8, 0.95), (0.95, 1.01)):
        part = (voted.confidence >= low) & (voted.confidence < high)
        assert part.sum() < 50 or (~right)[part].mean() <= 1.1 * (1 - voted.confidence[part]).mean() + 2e-3


@pytest.mark.long
@pytest.mark.parametrize("background", [0.02, 0.5, 5.0])
def test_background_alone_makes_no_surface(background, device):
    counts = np.random.default_rng(2).poisson(background, (64, 64, BINS)).astype(float)
    _, voted = vote(counts, device)
    assert (voted.confidence >= 0.95).mean() < 3e-3


def test_a_thin_object_before_a_wall_stays(device):
    """One column of forty photons at another time: its neighbours are all on the wall."""
    counts = wall(24, 25, 40.0, 0.5, 3)
    counts[:, 12] = wall(24, 1, 40.0, 0.5, 4, time=12.0)[:, 0]
    _, voted = vote(counts, device)
    column = voted.position.reshape(24, 25)[:, 12]
    assert (np.abs(column - 12.0) < 3).all()
    assert voted.confidence.reshape(24, 25)[:, 12].min() > 0.95


@pytest.mark.parametrize(("factor", "background"), [(1.0, 0.02), (1.0, 5.0), (10.0, 0.1), (0.04, 3.0), (2.7, 2.0)])
def test_the_unit_of_counts_is_found(factor, background):
    counts = factor * tof.histogram(tof.room(48, 64), 3000, background=background, seed=5).reshape(-1, BINS)
    scale = estimate_count_scale(counts.astype(np.float32))
    assert scale.units == pytest.approx(factor, rel=0.1)
    assert not scale.shared


def test_residuals_beyond_photon_noise_are_measured(device):
    """Photons of a pulse have dispersion 1; the same counts under a pulse half as wide do not."""
    counts = wall(20, 20, 3000.0, 1.0, 6).reshape(-1, BINS)
    histograms = without_pileup(place(counts, device))
    fits, narrow = (misfit(histograms, pulse, find_returns(histograms, pulse))[0] for pulse in (PULSE, gaussian(0.4)))
    assert (fits == 1).mean() > 0.98
    assert np.median(narrow) > 30


@pytest.mark.long
def test_pulses_are_counted_from_the_histograms(device):
    view = tof.room(24, 32)
    for pulses in (None, 800):
        counts = tof.histogram(view, 3000, background=1.0, seed=7, pulses=pulses).reshape(-1, BINS)
        found = estimate_pulses(counts, PULSE, device, lambda histograms, some: PULSE)
        assert (found is None) == (pulses is None)
    assert found is not None and found.pulses == pytest.approx(800, rel=0.1)
    assert found.used > 0.5


@pytest.mark.long
def test_counts_that_are_no_whole_numbers_are_rounded_before_they_are_summed_up(device):
    """As in histograms that were divided by their highest bin: sums of rounded bins are larger than rounded sums."""
    counts = tof.histogram(tof.room(24, 32), 3000, background=1.0, seed=7, pulses=800).reshape(-1, BINS)
    for photon in (0.11, 0.191, 0.205):
        estimate_pulses(counts / counts.max(axis=1, keepdims=True) / photon, PULSE, device, lambda histograms, some: PULSE)


def test_a_pulse_with_a_tail_has_unit_area_and_its_top_at_zero():
    pulse = with_tail(0.8, 1.5, 0.6)
    assert pulse.cumulative[-1] == 1
    assert abs(pulse.begin + pulse.step * np.argmax(pulse.density)) < 1e-9
    late = pulse.mean - with_tail(0.8, 1.5, 0.0).mean
    assert 0.5 < late < 0.6 * 1.5  # the tail's mean delay, less by how much the top moves
    with pytest.raises(ArrayError, match="the tail decays in 0 bins"):
        with_tail(0.8, 0, 0.5)


def test_a_flat_wall_is_no_pattern_of_the_camera():
    assert not pattern_bins(wall(16, 16, 2000.0, 0.5, 8).reshape(-1, BINS)).any()


def test_rows_in_turn_are_seen_and_steps_are_not():
    rows = np.arange(20)[:, None] * np.ones(20)
    everywhere = np.ones((20, 20), dtype=bool)
    assert interlaced(10 + 6.0 * (rows % 2), everywhere, 1.9)[3:-3].all()
    assert not interlaced(10 + 6.0 * (rows > 9), everywhere, 1.9).any()
