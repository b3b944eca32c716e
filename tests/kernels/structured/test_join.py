"""Phases put together and bands taken apart."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.structured.decoded import Decoded, cropped
from kernels.structured.pattern_frames import NoiseModel, upload
from kernels.structured.phase import decode_phase, join_periods

EIGHT_BIT = NoiseModel(0.003, 1.0e-4)
"""Noise of an ordinary camera of eight bits whose pixels hold ten thousand electrons, as parts of full scale."""


def test_joined_periods_are_those_decoded_together(device):
    u = np.linspace(3, 60, 45)
    shifts, periods = [i / 4 for i in range(4)] * 2, [16.0] * 4 + [23.0] * 4
    images = np.array([0.5 + 0.4 * np.cos(2 * np.pi * (u / p - s)) for p, s in zip(periods, shifts, strict=True)], np.float32)
    frames = upload(images, device=device)
    together = decode_phase(frames, range(8), periods, shifts, noise=EIGHT_BIT)
    parts = [decode_phase(frames, range(a, a + 4), periods[a:a + 4], shifts[a:a + 4], noise=EIGHT_BIT) for a in (0, 4)]
    joined = join_periods(parts)
    assert joined.periods_px == together.periods_px == (16.0, 23.0)
    for one, other in zip(joined[:5], together[:5], strict=True):
        assert (one.numpy()[:, :45] == other.numpy()[:, :45]).all()
    short = decode_phase(upload(images[:, :9].copy(), device=device), range(4), periods[:4], shifts[:4], noise=EIGHT_BIT)
    with pytest.raises(ArrayError, match="one phase has 45 pixels, another 9"):
        join_periods([parts[0], short])
    with pytest.raises(ArrayError, match="no phase is given"):
        join_periods([])


def test_a_crop_is_the_pixels_asked_for(device):
    values = np.arange(64, dtype=np.float32)
    planes = [wp.array(values + 100 * i, dtype=wp.float32, device=device) for i in range(3)]
    part = cropped(Decoded(*planes, wp.array(values.astype(np.uint8), dtype=wp.uint8, device=device)), 7, 21, device=device)
    for i, array in enumerate(part[:3]):
        assert (array.numpy()[:21] == values[7:28] + 100 * i).all()
    assert (part.status.numpy()[:21] == np.arange(7, 28)).all()
    with pytest.raises(ArrayError, match="pixels 60 to 70 are asked for, there are 64"):
        cropped(Decoded(*planes, planes[0]), 60, 10, device=device)
