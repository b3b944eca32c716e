"""Labels of connected parts against SciPy."""

import numpy as np
import pytest
from scipy import ndimage

from kernels.surface.components import label_runs


def painted(runs, shape):
    label = np.full(shape, -1)
    for row, first, end, number in zip(runs.row, runs.first_col, runs.end_col, runs.label, strict=True):
        label[row, first:end] = number
    return label


def spiral(n):
    """A path one pixel wide, wound to the middle."""
    mask = np.zeros((n, n), dtype=bool)
    r, c, dr, dc = 0, 0, 0, 1
    mask[0, 0] = True
    for length in [n - 1, *np.repeat(np.arange(n - 1, 0, -2), 2)]:
        for _ in range(length):
            r, c = r + dr, c + dc
            mask[r, c] = True
        dr, dc = dc, -dr
    return mask


@pytest.mark.parametrize(
    "mask",
    [
        *(np.random.default_rng(int(100 * f)).random((57, 83)) < f for f in (0.1, 0.45, 0.6, 0.65, 0.9)),
        np.ones((5, 7), dtype=bool),
        np.zeros((5, 7), dtype=bool),
        np.ones((1, 1), dtype=bool),
        np.ones((9, 1), dtype=bool),
        np.arange(12).reshape(1, 12) % 3 > 0,
        spiral(41),
        np.indices((20, 20)).sum(0) % 2 == 0,
    ],
)
def test_labels_match_scipy(mask):
    runs = label_runs(mask)
    expected, count = ndimage.label(mask)
    label = painted(runs, mask.shape)
    assert runs.count == count
    assert ((label >= 0) == mask).all()
    assert len(set(zip(label[mask], expected[mask], strict=True))) == count
