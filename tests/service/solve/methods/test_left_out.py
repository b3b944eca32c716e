"""Left-out lights say whether few lights support the general solver."""

import numpy as np
import pytest

from service.solve.methods.support import is_supported, leave_out
from tests.kernels.photometric.test_svbrdf import render, sample, tilted
from tests.kernels.scenes import cap
from tests.reference import microfacet as twin

LIGHTS = cap(12, 42.0)
"""Few frontal lights, as of hand-held captures."""
SUPPORTED = 0.7
"""Ratio of misfits above which the solve falls back to a prior where Lambert's law describes the object."""


@pytest.mark.parametrize(("alpha", "f0"), [(0.2, 0.06), (0.35, 0.2)])
def test_highlights_predict_left_out_lights(device, alpha, f0):
    """On a gloss the lobes that some lights show predict the others."""
    normal = tilted(96, 55.0)
    samples, _ = sample(render(normal, alpha=alpha, f0=f0, lights=LIGHTS), device, lights=LIGHTS)
    left = leave_out(samples, twin.unit(normal + [0.05, 0.03, 0]))
    assert left.general < 0.6 * SUPPORTED * left.lambert


def test_errors_of_lights_predict_nothing(device):
    """On a matt surface under lights that are 6° off and unequally bright, lobes only follow the errors of the lights that are kept."""
    rng = np.random.default_rng(5)
    normal = tilted(96, 55.0)
    radiance = render(normal, f0=None, lights=twin.unit(LIGHTS + 0.1 * rng.normal(size=LIGHTS.shape)))
    radiance = radiance * (1 + 0.06 * rng.normal(size=(1, len(LIGHTS), 1)))
    samples, _ = sample(radiance, device, lights=LIGHTS)
    left = leave_out(samples, normal)
    assert left.general > SUPPORTED * left.lambert and not is_supported(*left)


@pytest.mark.parametrize(("general", "lambert", "supported"), [
    (0.1, 0.12, False),  # Lambert's law describes the object: its normals are the surer ones
    (0.06, 0.12, True),
    (0.84, 1.13, True),  # it does not: gloss and metal in JPEG files, which were taken for velvet
    (1.1, 1.2, False),  # velvet
])
def test_lambert_is_no_refuge_where_it_does_not_describe_the_object(general, lambert, supported):
    assert is_supported(general, lambert) == supported
