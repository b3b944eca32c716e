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
