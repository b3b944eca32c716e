"""The logarithm of the kernels against that of float64."""

import numpy as np
import warp as wp

from kernels.logarithm import log_of


def test_it_is_the_logarithm(device):
    """Numbers of every size, and close to one. Tolerance: two roundings of the result or of the polynomial."""
    rng = np.random.default_rng(2)
    sizes, near_one = np.exp(rng.uniform(-87, 88, 20000)), 1 + rng.uniform(-0.3, 0.45, 20000)
    x = np.concatenate([sizes, near_one, [1.0, 2.0, 1e-37, 3e38]]).astype(np.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(x: wp.array(dtype=float), out: wp.array(dtype=float)):
        out[wp.tid()] = log_of(x[wp.tid()])

    out = wp.zeros(len(x), dtype=float, device=device)
    wp.launch(evaluate, dim=len(x), inputs=[wp.array(x, dtype=float, device=device)], outputs=[out], device=device)
    np.testing.assert_allclose(out.numpy(), np.log(x.astype(np.float64)), rtol=1.3e-7, atol=1.2e-7)
