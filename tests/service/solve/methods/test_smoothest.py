"""The pixels from which shared materials are chosen: smooth ones, from all over the object."""

import numpy as np

from service.solve.methods.kinds import MATERIAL_PIXELS, STRETCH, smoothest

SIDE = 160


def test_wrinkled_pixels_are_passed_over_wherever_smooth_ones_lie_between():
    """Every fourth column and the whole lower half are wrinkled: of the upper half all that are chosen lie between wrinkles, and the lower
    half, where nothing is smooth, has as many pixels as the upper."""
    random = np.random.default_rng(3)
    row, col = np.indices((SIDE, SIDE))
    wrinkled = (col % 4 == 0) | (row >= SIDE // 2)
    tilt = np.where(wrinkled, random.normal(size=(2, SIDE, SIDE)), 0)
    normal = np.stack([*tilt, np.ones((SIDE, SIDE))])
    normal /= np.linalg.norm(normal, axis=0)
    chosen = smoothest(np.arange(SIDE * SIDE), normal.reshape(3, -1), SIDE)
    above = chosen < SIDE * SIDE // 2
    assert len(np.unique(chosen)) == MATERIAL_PIXELS and above.sum() == MATERIAL_PIXELS // 2
    between = (chosen % SIDE) % 4 == 2  # the neighbours of all others are wrinkled
    assert between[above].mean() > 0.99 and between[~above].mean() < 0.5


def test_few_pixels_are_all_taken():
    """Where an object has fewer than it takes, or not enough for stretches of two, every pixel or an even part of them stays."""
    flat = np.tile(np.array([[0.0], [0.0], [1.0]]), (1, SIDE * SIDE))
    few = np.arange(0, 3 * 200, 3)
    np.testing.assert_array_equal(smoothest(few, flat, SIDE), few)
    assert len(smoothest(np.arange(2 * MATERIAL_PIXELS - 1), flat, SIDE)) == MATERIAL_PIXELS
    assert len(smoothest(np.arange(STRETCH * MATERIAL_PIXELS + 5), flat, SIDE)) == MATERIAL_PIXELS
