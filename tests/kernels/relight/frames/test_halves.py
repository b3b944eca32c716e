import numpy as np
import warp as wp

from kernels.relight.frames.halves import to_halves


def test_halves_are_rounded_as_numpy_does_and_infinite_beyond_the_range(device):
    rng = np.random.default_rng(0)
    values = (rng.normal(size=(2, 3, 64)) * 10.0 ** rng.integers(-9, 6, (2, 3, 64))).astype(np.float32)
    values[0, 0, :6] = 65504, 65505, -65505, np.inf, np.nan, 6e-8
    found = to_halves(wp.array(values, device=device)).numpy()
    with np.errstate(over="ignore"):
        wanted = values.astype(np.float16)
    wanted[np.abs(values) > 65504] = np.copysign(np.inf, values[np.abs(values) > 65504])
    np.testing.assert_array_equal(found, wanted)
    assert np.isinf(found).sum() > 5 and found[0, 0, 0] == 65504 and found[0, 0, 5] > 0
