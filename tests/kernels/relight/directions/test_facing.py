import numpy as np
import pytest

from kernels.relight.directions.direction_grid import direction_grid
from kernels.relight.directions.facing import ROUNDING, facing_directions


@pytest.mark.parametrize("count", [1, 500, 9000])
@pytest.mark.parametrize("spread", [0.0, 0.1, 0.5, 3.0])
def test_it_finds_the_directions_that_the_product_of_all_finds(count, spread):
    """Many normals are told by boxes first, of which the product knows nothing."""
    normals = np.array([0.2, 0.1, 1.0]) + spread * np.random.default_rng(count).normal(size=(count, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    towards = direction_grid().direction
    found = facing_directions(towards, normals)
    np.testing.assert_array_equal(found, np.flatnonzero((towards @ normals.T).max(axis=1) > -ROUNDING))
    assert (len(found) < len(towards)) == (spread < 0.5 or count == 1)
