"""The solver against a float64 direct solve of the same least squares."""

import numpy as np
import pytest

from kernels.surface.integrate import integrate_normals
from tests.kernels.surface import shapes
from tests.reference import surface as reference


@pytest.mark.parametrize("size", [(61, 83), (64, 64), (97, 40)])
@pytest.mark.parametrize("perspective", [False, True])
def test_random_bumpy_normals(size, perspective, device):
    """Normals that no surface has: the two must agree on the best fit."""
    rng = np.random.default_rng(size[0])
    normal = rng.normal(0, 0.4, (3, *size)) + np.array([0, 0, 1.5])[:, None, None]
    normal = (normal / np.linalg.norm(normal, axis=0)).astype(np.float32)
    normal[:, normal[2] < 0.35] = np.array([[0], [0], [1]], dtype=np.float32)
    mask = shapes.ragged_mask(*size, seed=size[1])
    x, y = (a.astype(np.float32) for a in shapes.plane_coordinates(*size, size=0.4))
    how = {"perspective": perspective, "mean_z": -2.0}
    result = integrate_normals(normal, mask, x, y, **how, device=device)
    truth = reference.integrate(normal, mask, x, y, **how)
    assert result.converged
    height = result.height.numpy()
    # float32 rounding of the result (1e-7 of z = −2) and the stopping tolerance
    assert np.abs(height - truth).max() < 5e-7 + 1e-5 * np.ptp(truth[mask])
    assert (height[~mask] == 0.0).all()
