"""Backward warping against a slow float64 twin with the sixteen values written out."""

import numpy as np
import pytest

from stage.motion.resample import bicubic, positions, touched

RNG = np.random.default_rng(3)
ROWS, COLS = 9, 13


def keys(distance: float) -> float:
    """Keys 1981, eq. 15."""
    d = abs(distance)
    return 1.5 * d**3 - 2.5 * d**2 + 1 if d < 1 else -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2 if d < 2 else 0.0


def twin(image: np.ndarray, x: float, y: float) -> np.ndarray:
    total = np.zeros(image.shape[2])
    for r in range(int(np.floor(y)) - 1, int(np.floor(y)) + 3):
        for c in range(int(np.floor(x)) - 1, int(np.floor(x)) + 3):
            inside = np.clip(r, 0, ROWS - 1), np.clip(c, 0, COLS - 1)
            total += keys(x - c) * keys(y - r) * image[inside]
    return total


def somewhere() -> tuple[np.ndarray, np.ndarray]:
    x, y = RNG.uniform(0, COLS - 1, (ROWS, COLS)), RNG.uniform(0, ROWS - 1, (ROWS, COLS))
    x[0, :3], y[0, :3] = (0, COLS - 1, 4), (0, ROWS - 1, 4.5)  # corners, and a whole number of pixels
    return x.astype(np.float32), y.astype(np.float32)


def test_bicubic_is_the_kernel_of_keys():
    image, (x, y) = RNG.uniform(0, 5, (ROWS, COLS, 3)).astype(np.float32), somewhere()
    expected = [[twin(image.astype(np.float64), float(x[r, c]), float(y[r, c])) for c in range(COLS)] for r in range(ROWS)]
    assert np.allclose(bicubic(image, x, y), expected, atol=2e-5)  # float32: 2^-24 of values and second differences up to 20


def test_at_whole_pixels_nothing_is_resampled():
    image = RNG.normal(0, 1, (ROWS, COLS, 3)).astype(np.float32)
    x, y, inside = positions(np.zeros((ROWS, COLS, 2), np.float32))
    assert inside.all() and np.array_equal(bicubic(image, x, y), image)


def test_positions_outside_are_told_and_brought_to_the_edge():
    displacement = np.zeros((3, 4, 2), np.float32)
    displacement[1] = [[-0.01, 0], [2.5, 0], [0, -1.5], [0, 1]]
    x, y, inside = positions(displacement)
    assert inside[1].tolist() == [False, False, False, True] and inside[[0, 2]].all()
    assert x[1].tolist() == [0, 3, 2, 3] and y[1].tolist() == [1, 1, 0, 2]


@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
def test_every_reading_that_a_flagged_pixel_takes_part_in_is_flagged(share):
    flags, (x, y) = RNG.random((ROWS, COLS)) < share, somewhere()
    found = touched(flags, x, y)
    for r in range(ROWS):
        for c in range(COLS):
            i, j = int(y[r, c]), int(x[r, c])
            assert found[r, c] == flags[max(i - 1, 0) : i + 3, max(j - 1, 0) : j + 3].any()
