"""Fog in histograms is named and no surface, and clipped counters are not taken for returns: a slope with a box before it and printed
albedo, pulses integrated over the bins in closed form."""

import numpy as np
import pytest
from scipy.special import ndtr

from service.depth.tof.shared_light import find_fog
from tests.reference import tof
from tests.scenes.depth import depth_of
from tests.scenes.tof import far_camera, pulsed_frames, write

ROWS, COLS, BINS, BIN_M, WIDTH_M = 24, 32, 60, 0.1, 0.09


def view():
    x, y = np.meshgrid(np.linspace(-1, 1, COLS), np.linspace(-1, 1, ROWS))
    distance = np.where((np.abs(x + 0.2) < 0.3) & (np.abs(y) < 0.5), 2.1, 3.6 + 0.9 * x - 0.4 * y)
    return distance.ravel(), (0.35 + 0.3 * (np.sin(9 * x) * np.sin(7 * y) > 0)).ravel()


def histograms(density, photons=40000.0, background=1.0):
    """Counts [pixel, bin] through fog of this scattering coefficient, 1/m, and the true distances."""
    distance, albedo = view()
    edges = np.arange(BINS + 1) * BIN_M
    mean = np.full((len(distance), BINS), background)
    strength = photons * albedo / distance**2 * np.exp(-2 * density * distance)
    mean += strength[:, None] * np.diff(ndtr((edges - distance[:, None]) / WIDTH_M), axis=1)
    steps = np.arange(0.2, 5.0, 0.02)
    back = photons * density / 4 / steps**2 * np.exp(-2 * density * steps) * 0.02
    parts = back[:, None] * np.diff(ndtr((edges - steps[:, None]) / WIDTH_M), axis=1)
    mean += (steps < distance[:, None]).astype(float) @ parts
    return np.random.default_rng(11).poisson(mean).astype(np.float32), distance


def solved(folder, counts):
    """What relit depth makes of the counts."""
    frames = pulsed_frames(counts.reshape(ROWS, COLS, BINS), bin_s=2 * BIN_M / tof.LIGHT)
    write(folder, frames, camera=far_camera(ROWS, COLS))
    return depth_of(folder)


@pytest.mark.long
def test_fog_is_named_and_is_no_surface(tmp_path):
    counts, distance = histograms(0.15)
    found = solved(tmp_path, counts)
    mask = found.maps.mask.ravel()
    ratio = np.abs(found.maps.range.ravel() - distance)[mask] / found.maps.sigma.ravel()[mask]
    assert any("as fog returns it" in words for words in found.warnings)
    assert mask.mean() > 0.3 and np.median(ratio) < 1.4 and np.mean(ratio > 5) < 0.01  # the shift by the slope is a bound


@pytest.mark.long
def test_fog_that_hides_everything_leaves_nothing_solved(tmp_path):
    counts, _ = histograms(1.5)
    assert not solved(tmp_path, counts).maps.mask.any()


@pytest.mark.parametrize("change", ["clear", "pane", "own light", "wall with a tail"])
def test_clear_air_shows_no_fog(change):
    counts, _ = histograms(0.0)
    time = np.arange(BINS)
    if change == "pane":
        counts = counts + np.random.default_rng(1).poisson(300 * np.exp(-0.5 * ((time - 6.3) / 0.9) ** 2), counts.shape)
    if change == "own light":
        counts = counts + np.random.default_rng(1).poisson(900 * np.exp(-0.5 * ((time - 2.3) / 0.9) ** 2), counts.shape)
    if change == "wall with a tail":
        pulse = np.where(time >= 15, np.exp(-(time - 15) / 4.0), 0)
        counts = np.random.default_rng(1).poisson(500 * pulse + 1, counts.shape)
    assert find_fog(counts, 0.0, BIN_M) is None


@pytest.mark.long
def test_clipped_counts_are_no_returns(tmp_path):
    """A counter of eight bits: where it is full, the status says so, and the others keep their deviations."""
    counts, distance = histograms(0.0, photons=9000.0)
    found = solved(tmp_path, np.minimum(counts, 255))
    mask, full = found.maps.mask.ravel(), (counts >= 255).any(axis=1)
    ratio = np.abs(found.maps.range.ravel() - distance)[mask] / found.maps.sigma.ravel()[mask]
    assert full.sum() > 50 and not (mask & full).any() and mask[~full].mean() > 0.95
    assert any("255" in words for words in found.warnings) and np.median(ratio) < 1.2 and np.mean(ratio > 5) < 0.01
