"""Counts that stop at a counter's ceiling are told from those that photons reach."""

import numpy as np
import pytest

from service.depth.tof.histograms import full_count

RANDOM = np.random.default_rng(4)
PLACES = RANDOM.uniform(12, 50, (700, 1))
PULSES = np.exp(-0.5 * ((np.arange(64) - PLACES) / 1.5) ** 2)
COUNTS = RANDOM.poisson(260 * RANDOM.uniform(0.1, 1.5, (700, 1)) * PULSES + 2).astype(np.float32)


@pytest.mark.parametrize("counts", [COUNTS, COUNTS / COUNTS.max(axis=1, keepdims=True), np.minimum(COUNTS, 12)],
                         ids=["photons", "each over its largest", "few"])
def test_photons_show_no_ceiling(counts):
    assert full_count(counts) is None


@pytest.mark.parametrize("ceiling", [255, 150])
def test_a_ceiling_is_found(ceiling):
    assert full_count(np.minimum(COUNTS, ceiling)) == ceiling
