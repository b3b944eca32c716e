"""Readings of wide lights divided by the part that is seen."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.photometric.model.samples import readings_of
from kernels.photometric.shadows.shadowing import LEAST_PART, divide_by_visible
from tests.kernels.photometric.test_svbrdf import sample


def test_a_part_of_the_light_is_made_whole_and_hardly_any_is_none(device):
    """Tolerance: half rounding of the images."""
    rng = np.random.default_rng(2)
    whole, part = rng.uniform(0.2, 1, (7, 45)), rng.uniform(0, 1, (45, 7)).astype(np.float32)
    samples, _ = sample(np.repeat((whole * part.T)[None], 3, axis=0), device, lights=np.tile([0.0, 0.0, 1.0], (7, 1)))
    divide_by_visible(samples, part)
    read = readings_of(samples)
    kept = part >= LEAST_PART
    np.testing.assert_allclose(read[kept], whole.T[kept], rtol=2**-10)
    assert (read[~kept] < 0).all() and (~kept).any()
    with pytest.raises(ArrayError, match="part is"):
        divide_by_visible(samples, part.T)
