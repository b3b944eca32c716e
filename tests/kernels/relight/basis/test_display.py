"""Display values of a stack."""

import numpy as np
import pytest

from kernels import packs
from kernels.errors import ArrayError
from kernels.relight.basis.rti import encode
from tests.kernels.scenes import store
from tests.reference.colour import srgb

MATRIX = np.array([[1.7, -0.6, -0.1], [-0.1, 1.1, 0.0], [0.0, -0.1, 1.1]])
HALF_STEP = 2.0**-12
"""Largest error of a half value below one."""


def values(band, pixels):
    flat = band.values.numpy().astype(np.float64)
    return flat.reshape(3, band.frame_count, -1)[:, :, :pixels]


def expected(stack, gains):
    scene = stack.astype(np.float64) * gains[:, :, None]
    return srgb(np.einsum("dc,clp->dlp", MATRIX, scene))


@pytest.mark.parametrize("pixels", [1, 33, 500])
def test_display_values(pixels, device):
    rng = np.random.default_rng(0)
    stack, gains = store(rng.gamma(0.5, 1.0, (3, 9, pixels))), np.zeros((3, 16))
    gains[:, :8] = rng.uniform(0.001, 1, (3, 8))  # the ninth is left out, the rest is padding
    source = packs.upload(stack, device=device)
    before = source.values.numpy().copy()
    found = values(encode(source, gains, MATRIX), pixels)
    assert np.array_equal(source.values.numpy(), before)
    assert np.abs(found - expected(stack, gains)).max() < HALF_STEP + 2e-6  # and powers in float
    assert not found[:, 8:].any()


def test_what_does_not_fit_is_refused(device):
    band = packs.upload(store(np.ones((3, 8, 4))), device=device)
    with pytest.raises(ArrayError, match=r"gains are \(3, 9\), expected \(3, 8\)"):
        encode(band, np.ones((3, 9)), np.eye(3))
    with pytest.raises(ArrayError, match="display_from_stack"):
        encode(band, np.ones((3, 8)), np.full((3, 3), np.nan))
