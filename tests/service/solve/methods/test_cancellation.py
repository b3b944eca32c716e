"""The doubt that a pixel takes over from its neighbours."""

import numpy as np

from service.solve.methods.gradient import PART, neighbours_doubt


def test_a_pixel_between_doubtful_ones_is_as_doubtful():
    """Two doubtful regions with a line between them where occlusion and interreflection cancel."""
    doubt, inside = np.zeros((64, 64)), np.ones((64, 64), bool)
    doubt[:, 10:20], doubt[:, 21:31] = 12.0, 8.0
    found = neighbours_doubt(doubt, inside)
    assert (found[:, 20] == 12).all() and (found[:, 10:20] == 12).all()
    reach = 64 // PART
    assert (found[:, 32 + reach :] == 0).all() and (found[:, : 9 - reach] == 0).all()
    assert np.array_equal(neighbours_doubt(doubt.T, inside), found.T)


def test_it_is_the_largest_of_the_window():
    """Against a plain loop."""
    doubt = np.repeat(np.repeat(np.random.default_rng(1).uniform(0, 9, (16, 16)), 4, axis=0), 4, axis=1)
    found, reach = neighbours_doubt(doubt, np.ones((64, 64), bool)), 64 // PART
    smooth = np.sort([np.pad(doubt, 1)[r : r + 64, c : c + 64] for r in range(3) for c in range(3)], axis=0)[-3]
    for row, col in ((0, 0), (5, 63), (30, 31), (63, 12)):
        window = smooth[max(0, row - reach) : row + reach + 1, max(0, col - reach) : col + reach + 1]
        assert found[row, col] == np.float32(max(window.max(), doubt[row, col]))


def test_nothing_is_doubted_outside_the_mask():
    inside = np.zeros((20, 20), bool)
    assert not neighbours_doubt(np.zeros((20, 20)), inside).any()
    inside[5:15, 5:15] = True
    found = neighbours_doubt(np.where(inside, 3.0, 0.0), inside)
    assert (found[inside] == 3).all() and not found[~inside].any()
