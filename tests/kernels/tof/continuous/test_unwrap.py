"""Wraps: make a phase, wrap it, unwrap it; against a search over every range; the vote; and the flags."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.tof.continuous.continuous import Noise, decode
from kernels.tof.continuous.decide import decide
from kernels.tof.continuous.unwrap import decay, unwrap, vote
from tests.kernels.tof.histogram.test_returns import flat_view
from tests.reference import tof

FAR = 14.98
NOISE = Noise(1.0, 5.0)


@wp.kernel(enable_backward=False, module="unique")
def decay_kernel(x: wp.array(dtype=wp.float32), found: wp.array(dtype=wp.float32)):
    found[wp.tid()] = decay(x[wp.tid()])


def solve(images, settings, device, *, far=FAR, near=0.0, noise=NOISE, shape=None, **options):
    hz, delta = (np.array(column) for column in zip(*settings, strict=True))
    flat = images.reshape(len(settings), -1).astype(np.float32)
    found = decode(flat, hz, delta, noise=noise, device=device, **options)
    weighed = unwrap(found, nearest_m=near, farthest_m=far, light_speed=tof.LIGHT)
    if shape is not None:
        weighed = vote(weighed, *shape)
    result = decide(found, weighed, light_speed=tof.LIGHT)
    return {name: getattr(result, name).numpy()[: flat.shape[1]] for name in result._fields}


def test_without_noise_every_range_of_fifteen_metres_is_exact(device):
    distance = np.linspace(0.02, 14.95, 3000)
    found = solve(tof.correlations(flat_view(distance), 1e5, tof.even(tof.HZ, 4)), tof.even(tof.HZ, 4), device)
    assert np.abs(found["range"] - distance).max() < 5e-5
    assert (found["status"] == Status.OK).all()
    np.testing.assert_array_equal(found["wraps"], np.floor(distance * 2 * 80e6 / tof.LIGHT))


@pytest.mark.parametrize(("hz", "far"), [((30e6,), 4.9), ((16e6, 80e6, 120e6), 18.7), ((60e6, 100e6), 7.4),
                                         ((20e6, 30e6, 50e6, 80e6, 100e6), 14.9)])
def test_any_number_of_frequencies(hz, far, device):
    distance = np.linspace(0.02, far - 0.02, 500)
    found = solve(tof.correlations(flat_view(distance), 1e5, tof.even(hz, 3)), tof.even(hz, 3), device, far=far)
    assert np.abs(found["range"] - distance).max() < 5e-5


def test_ranges_are_the_most_likely_ones(device):
    view = tof.room(12, 25)
    settings = tof.even(tof.HZ, 4)
    images = tof.correlations(view, 5e3, settings, seed=7).reshape(12, -1)
    found = solve(images, settings, device)
    hz, delta = (np.array(column) for column in zip(*settings, strict=True))
    decoded = decode(images.astype(np.float32), hz, delta, noise=Noise(1.0, 5.0), device=device)
    twin = tof.most_likely_range(decoded.phase.numpy()[:, :300].astype(float), decoded.sigma.numpy()[:, :300].astype(float), tof.HZ, FAR)
    there = found["range"] > 0
    assert there.mean() > 0.5
    assert np.mean(np.abs(found["range"] - twin)[there] < 0.005) > 0.99  # steps of 2 mm; nearly equal wraps may fall either way


def test_noise_figures_of_the_room(device):
    """Reach: median error, wrong wraps with and without the vote, and sigma against what is observed, at full light and a fifth."""
    view, settings = tof.room(), tof.even(tof.HZ, 4)
    truth = view.distance.reshape(-1)
    for part, median_m, alone, voted in ((1.0, 7.2e-3, 0.006, 0.002), (0.2, 18.5e-3, 0.024, 0.01)):
        images = tof.correlations(view, 1e5 * part, settings, seed=11)
        for shape, wrong in ((None, alone), (view.distance.shape, voted)):
            found = solve(images, settings, device, shape=shape)
            error = found["range"] - truth
            assert np.median(np.abs(error)) <= median_m
            assert np.mean(np.abs(error) > 0.9) <= wrong  # half the wrap distance of 80 MHz; unsolved counts as wrong
            near = np.abs(error) < 0.9
            assert np.sqrt(np.mean((error[near] / found["sigma"][near]) ** 2)) == pytest.approx(1, abs=0.1)


def test_the_vote_mends_wraps_that_a_pixel_leaves_open(device):
    view, settings = tof.room(), tof.even((70e6, 80e6), 4)  # two near frequencies: wraps are easily confused
    images = tof.correlations(view, 1e4, settings, ambient=50, seed=2)
    alone, voted = (solve(images, settings, device, shape=shape) for shape in (None, view.distance.shape))
    inside = view.distance.reshape(-1) < 14
    wrong = [np.mean(np.abs(found["range"] - view.distance.reshape(-1))[inside & (found["range"] > 0)] > 0.5) for found in (alone, voted)]
    assert wrong[0] > 0.01
    assert wrong[1] < 0.3 * wrong[0]
    same = np.abs(alone["range"] - voted["range"]) < 1e-6
    changed = ~same & (alone["range"] > 0)
    assert np.abs(alone["range"] - voted["range"])[changed].min() > 0.3  # another wrap; nothing is smoothed


def test_two_returns_are_flagged(device):
    view, settings = flat_view(np.linspace(1, 6, 400)), tof.even(tof.HZ, 4)
    found = solve(tof.correlations(view, 1e5, settings, seed=1, second=(1.3, 0.4)), settings, device)
    assert np.mean(found["status"] == Status.MULTIPATH) > 0.9
    assert np.mean(solve(tof.correlations(view, 1e5, settings, seed=1), settings, device)["status"] == Status.OK) > 0.99


def test_ambient_is_never_signal(device):
    settings = tof.even(tof.HZ, 4)
    dark = flat_view(np.full(20000, 3.0), albedo=0.0)
    found = solve(tof.correlations(dark, 1e5, settings, ambient=20000, seed=4), settings, device)
    assert np.count_nonzero(found["status"] != Status.LOW_MODULATION) <= 1  # one in a million a pixel
    assert found["range"][found["status"] == Status.LOW_MODULATION].max() == 0


def test_saturation_takes_a_frequency_or_the_pixel(device):
    settings = tof.even(tof.HZ, 4)
    images = tof.correlations(flat_view(np.array([2.0, 2.0, 2.0])), 1e5, settings)
    images[:4, 0, 1] = 1e6  # 20 MHz is gone: 30 and 80 MHz still repeat only after 14.99 m
    images[:, 0, 2] = 1e6
    found = solve(images, settings, device, saturation=1e6)
    assert list(found["status"]) == [Status.OK, Status.OK, Status.SATURATED]
    np.testing.assert_allclose(found["range"], [2, 2, 0], atol=5e-5)


def test_a_range_outside_the_span_is_out_of_range(device):
    settings = tof.even((20e6,), 4)
    found = solve(tof.correlations(flat_view(np.array([1.0, 5.0])), 1e5, settings), settings, device, far=3.0)
    assert list(found["status"]) == [Status.OK, Status.OUT_OF_RANGE]


def test_wraps_that_fit_equally_well_are_kept_without_confidence(device):
    settings = tof.even((20e6, 80e6), 4)
    images = tof.correlations(flat_view(np.array([1.0])), 1e5, settings)
    images[:4] = 1e6  # only 80 MHz is left, which repeats after 1.87 m
    found = solve(images, settings, device, far=7.4, saturation=1e6)
    assert found["status"][0] == Status.OK and found["range"][0] > 0  # whether that is sure enough is for the caller to say
    assert found["confidence"][0] < 0.5


def test_too_long_a_span_is_refused(device):
    settings = tof.even((20e6, 30e6), 4)
    with pytest.raises(ArrayError, match=r"repeat after 14.99 m"):
        solve(tof.correlations(flat_view(np.array([1.0])), 1e5, settings), settings, device, far=20.0)


def test_decay_is_the_exponential(device):
    x = np.concatenate([np.linspace(0, 80, 100_001), [80.0, 200.0, 1e20]]).astype(np.float32)
    found = wp.empty(len(x), dtype=wp.float32, device=device)
    wp.launch(decay_kernel, dim=len(x), inputs=[wp.array(x, device=device)], outputs=[found], device=device)
    np.testing.assert_allclose(found.numpy(), np.exp(-np.minimum(x.astype(float), 80)), rtol=3e-7)  # the series 1.2e-7, the rest float32
