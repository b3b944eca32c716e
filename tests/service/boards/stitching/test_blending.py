"""What the shifts of tiles make of sums over a blend, in closed form."""

import numpy as np
import pytest

from service.boards.stitching.blending import LEAST_SHIFT_PX, Blender
from service.boards.stitching.grid import BoardGrid, HeightPatch
from service.boards.stitching.motions import Motions

PIXEL, HIGH, SIGMA = 1e-5, 1e-4, 8e-6
GRID = BoardGrid(PIXEL, -20 * PIXEL, 15 * PIXEL, 30, 40)


@pytest.mark.parametrize(("left", "right", "together", "truth"), [
    (slice(0, 40), slice(40, 40), 0.0, 0.0),  # whole on one tile
    (slice(0, 20), slice(20, 40), 0.0, np.sqrt(2)),  # half of it on each: it grows by as much as the tiles part
    (slice(0, 20), slice(20, 40), 1.0, 0.0),  # both are wrong alike
    (slice(0, 20), slice(20, 40), -1.0, 2.0),
    (slice(0, 40), slice(0, 40), -1.0, 0.0),  # whole on both
    (slice(0, 25), slice(15, 40), -1.0, 2.0),  # half of it on each, within the overlap it counts half
])
def test_a_box_changes_only_where_tiles_part_on_it(left, right, together, truth):
    """A box of 10 x 20 pixels: the sum changes by its height times its 10 rows times the pixels by which two tiles come apart on it."""
    row, col = np.mgrid[:30, :40]
    height = np.where((abs(row - 14.5) < 5) & (abs(col - 19.5) < 10), HIGH, 0.0)
    covariance = np.zeros((12, 12))
    covariance[0, 0] = covariance[6, 6] = SIGMA**2
    covariance[0, 6] = covariance[6, 0] = together * SIGMA**2
    motions = Motions(np.zeros((2, 6)), covariance, (), 0.0)
    blender = Blender(GRID, centre=(0.0, 0.0), length_m=20 * PIXEL)
    for number, cols in enumerate((left, right)):
        part = height[:, cols]
        blender.add(HeightPatch(0, cols.start, part, np.full(part.shape, 1e-12), 1.0), motions.of_tile(number), 0.0, noise_factor=1.0)
    box = (slice(3, 27), slice(4, 36))
    found = blender.errors(motions).shift_sigma(box, tuple(np.mgrid[:24, :32]), height[box], np.ones((24, 32), dtype=bool))
    exact = HIGH * 10 * truth * SIGMA / PIXEL
    assert found == pytest.approx(exact, abs=2 * LEAST_SHIFT_PX * 10 * HIGH)
    steady = blender.errors(motions).steady
    assert steady == pytest.approx(np.zeros(steady.shape), abs=1e-9)
