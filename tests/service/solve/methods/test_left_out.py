"""Left-out lights say whether few lights support the general solver."""

import numpy as np
import pytest

from service.solve.methods.support import leave_out
from tests.kernels.photometric.test_svbrdf import render, sample, tilted
from tests.kernels.scenes import cap
from tests.reference import microfacet as twin

LIGHTS = cap(12, 42.0)
"""Few frontal lights, as of hand-held captures."""
SUPPORTED = 0.7
"""Ratio above which the solve falls back to a prior."""


@pytest.mark.parametrize(("alpha", "f0"), [(0.2, 0.06), (0.35, 0.2)])
def test_highlights_predict_left_out_lights(device, alpha, f0):
    """On a gloss the lobes that some lights show predict the others."""
    normal = tilted(96, 55.0)
    samples, _ = sample(render(normal, alpha=alpha, f0=f0, lights=LIGHTS), device, lights=LIGHTS)
    assert leave_out(samples, twin.unit(normal + [0.05, 0.03, 0])).ratio < 0.6 * SUPPORTED


def test_errors_of_lights_predict_nothing(device):
    """On a matt surface under lights that are 6° off and unequally bright, lobes only follow the errors of the lights that are kept."""
    rng = np.random.default_rng(5)
    normal = tilted(96, 55.0)
    radiance = render(normal, f0=None, lights=twin.unit(LIGHTS + 0.1 * rng.normal(size=LIGHTS.shape)))
    radiance = radiance * (1 + 0.06 * rng.normal(size=(1, len(LIGHTS), 1)))
    samples, _ = sample(radiance, device, lights=LIGHTS)
    assert leave_out(samples, normal).ratio > SUPPORTED
