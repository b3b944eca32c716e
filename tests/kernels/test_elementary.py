"""Elementary functions and halves of the kernels against those of NumPy."""

import numpy as np
import pytest
import warp as wp

from kernels import device as devices
from kernels.elementary import angle_of, cosine_of_turns, log_of, sine_of_turns
from kernels.packs import to_half


@wp.kernel(enable_backward=False, module="unique")
def angles_kernel(first: int, x: wp.array(dtype=float), y: wp.array(dtype=float), turns: wp.array(dtype=float),
                  # outputs
                  angle: wp.array(dtype=float), cosine: wp.array(dtype=float), sine: wp.array(dtype=float)):
    i = first + wp.tid()
    angle[i] = angle_of(x[i], y[i])
    cosine[i] = cosine_of_turns(turns[i])
    sine[i] = sine_of_turns(turns[i])


def run(x, y, turns, device):
    given = [wp.array(np.asarray(values, dtype=np.float32), device=device) for values in (x, y, turns)]
    outputs = [wp.zeros(len(x), dtype=wp.float32, device=device) for _ in range(3)]
    devices.launch(angles_kernel, len(x), given, outputs, device=device)
    return [output.numpy() for output in outputs]


def test_as_numpy_in_double(device):
    rng = np.random.default_rng(0)
    turn = rng.uniform(0, 2 * np.pi, 200000)
    length = 10.0 ** rng.uniform(-6, 6, turn.size)
    x, y = (length * np.cos(turn)).astype(np.float32), (length * np.sin(turn)).astype(np.float32)
    turns = rng.uniform(-4, 4, turn.size).astype(np.float32)
    angle, cosine, sine = run(x, y, turns, device)
    expected = np.arctan2(y.astype(float), x.astype(float)) % (2 * np.pi)
    assert np.abs(np.angle(np.exp(1j * (angle - expected)))).max() < 8e-7  # float32 of 2π is 5e-7
    assert np.abs(cosine - np.cos(2 * np.pi * turns.astype(float))).max() < 2e-6  # a quarter less t in float32
    assert np.abs(sine - np.sin(2 * np.pi * turns.astype(float))).max() < 2e-6


def test_axes_and_zero(device):
    angle, *_ = run([1, 0, -1, 0, 0, 1], [0, 1, 0, -1, 0, 1], [0] * 6, device)
    np.testing.assert_allclose(angle, np.array([0, 0.5, 1, 1.5, 0, 0.25]) * np.pi, atol=1e-6)


def test_the_logarithm(device):
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


@pytest.mark.parametrize("shape", [(1,), (31,), (32,), (3, 1000), (0,), (2, 0, 5)])
def test_values_are_those_of_numpy(shape):
    values = np.random.default_rng(1).normal(0, 300, shape).astype(np.float32)
    np.testing.assert_array_equal(to_half(values).view(np.uint16), values.astype(np.float16).view(np.uint16))


def test_every_half_and_the_middles_between_them_round_alike():
    """Ties, denormals, both zeros, infinities and values beyond the largest half."""
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    kept = halves[~np.isnan(halves)].astype(np.float32)
    middles = np.concatenate([(kept[:-1] + kept[1:]) / 2, np.float32([65519.9, 65520, -65520, 1e30])])
    for values in (kept, middles[~np.isnan(middles)]):
        with np.errstate(over="ignore"):
            expected = values.astype(np.float16)
        np.testing.assert_array_equal(to_half(values).view(np.uint16), expected.view(np.uint16))


def test_what_is_no_number_stays_none():
    assert np.isnan(to_half(np.full(70, np.nan, np.float32))).all()


def test_a_part_of_an_array_is_converted():
    whole = np.random.default_rng(2).normal(size=(4, 90)).astype(np.float32)
    np.testing.assert_array_equal(to_half(whole[:, 3:70]), whole[:, 3:70].astype(np.float16))
