"""The offset between rows of two images of waves, which are exact between pixels."""

import numpy as np
import pytest

from service.depth.stereo.row_offset import row_offsets


@pytest.mark.parametrize("offset", [-0.7, 0.0, 0.3])
def test_an_offset_is_measured(offset):
    rng = np.random.default_rng(0)
    wave, phase = rng.uniform(-1, 1, (40, 2)), rng.uniform(0, 2 * np.pi, 40)
    y, x = np.mgrid[:60, :120].astype(float)

    def image(at_x, at_y):
        return (0.5 + 0.05 * sum(np.cos(k[0] * at_x + k[1] * at_y + p) for k, p in zip(wave, phase, strict=True))).astype(np.float32)

    left, right = image(x, y), 0.6 * image(x + 7, y - offset) + 0.1  # lower by the offset
    flat = np.zeros_like(left)
    usable = np.zeros(left.shape, bool)
    usable[:, 25:-8] = True
    found = row_offsets(left, right, flat + 7, flat, flat, usable, most=200)
    assert len(found) == 200 and np.abs(found - offset).max() < 0.02  # bicubic interpolation
    assert len(row_offsets(left, right, flat + 7, flat, flat, ~usable & False, most=200)) == 0
