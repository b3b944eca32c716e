"""Materials that neighbours agree on: lobes of pixels whose normals are unsure."""

import numpy as np
import pytest

from kernels.status import Status
from service.solve.base.solution import Solution
from service.solve.coherent_materials import agree_on_materials

SIDE = 6


@pytest.mark.parametrize(("f0", "sigma", "roughness"), [
    (0.04, 20.0, np.sqrt(0.25 * np.radians(20.0))),  # the dielectric's lobe is as wide as its normal is unsure
    (0.04, 1.0, 0.2), (0.9, 20.0, 0.2)])  # narrower than the lobe; a metal
def test_a_lobe_is_not_narrower_than_its_normal_is_sure(f0, sigma, roughness):
    """Tolerance: maps are half values."""
    solution = Solution.empty(SIDE**2)
    solution.status[:] = Status.OK
    solution.albedo[:] = 0.3
    solution.specular, solution.roughness = np.full((3, SIDE**2), f0, np.float16), np.full(SIDE**2, 0.2, np.float16)
    agree_on_materials(solution, np.full(SIDE**2, sigma, np.float32), (SIDE, SIDE), "cpu")
    np.testing.assert_allclose(solution.roughness, roughness, rtol=1e-3)
    np.testing.assert_allclose(solution.specular, f0, rtol=1e-3)


def test_blurred_metals_keep_what_their_readings_say_and_bound_no_surface():
    """Among paint: their lobes are wider than those of their material, and their outline is ragged."""
    solution, middle = Solution.empty(SIDE**2), SIDE * 3 + 3
    solution.status[:] = Status.OK
    solution.albedo[:] = 0.3
    solution.specular, solution.roughness = np.full((3, SIDE**2), 0.04, np.float16), np.full(SIDE**2, 0.5, np.float16)
    solution.albedo[:, middle], solution.specular[:, middle], solution.roughness[middle] = 0, 0.9, 0.3
    assert solution.whole_metals().max() > 0.8
    solution.blurred = np.array([middle])
    agree_on_materials(solution, np.full(SIDE**2, 20.0, np.float32), (SIDE, SIDE), "cpu")
    np.testing.assert_allclose([solution.roughness[middle], *solution.specular[:, middle]], [0.3, 0.9, 0.9, 0.9], rtol=1e-3)
    assert solution.whole_metals().max() < 0.1
