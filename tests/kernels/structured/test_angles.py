import numpy as np
import warp as wp

from kernels import device as devices
from kernels.structured.angles import angle_of, cosine_of_turns, sine_of_turns


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
